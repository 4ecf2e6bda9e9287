"""Linear operators on pictures and samples, each with its adjoint."""
