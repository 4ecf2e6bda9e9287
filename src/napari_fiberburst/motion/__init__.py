"""Step 2: how the object moves from frame to frame."""
