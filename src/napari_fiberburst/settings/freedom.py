"""How the frames of a long recording may lie, by the name that it is asked for."""

from typing import Final

# Degrees of freedom of each frame; None for as many as the frames ask for.
FREEDOM: Final = {"auto": None, "translation": 2, "similarity": 4}
