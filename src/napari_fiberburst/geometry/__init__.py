"""Coordinates and plane projective transforms."""
