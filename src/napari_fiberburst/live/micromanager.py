"""What pymmcore-plus has for cameras, imported without a change to the log of everybody else.

Importing it sets the level of the root logger to DEBUG: all that any library tells would be logged.
"""

import logging

_level = logging.root.level
try:
    from pymmcore_plus import CMMCorePlus
    from pymmcore_plus.core import Keyword
    from pymmcore_plus.experimental.unicore import SimpleCameraDevice, UniMMCore
finally:
    logging.root.setLevel(_level)

__all__ = ["CMMCorePlus", "Keyword", "SimpleCameraDevice", "UniMMCore"]
