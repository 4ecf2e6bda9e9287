"""Long recordings: where every frame lies, one wide mosaic, a clean video, and folders of them."""
