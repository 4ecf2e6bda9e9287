"""Networks over coordinates that stand for the scene and for its motion: the published method and its ablations."""
