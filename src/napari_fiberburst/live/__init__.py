"""The picture of a bundle while it is held: one for every frame, sharper with each, without Qt."""
