"""Step 4: the scene as a linear spline, solved for."""
