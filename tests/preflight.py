"""Before the tests: load what rests on libraries of the system, and name the package of one that is missing."""

import importlib
import importlib.util
import re
import sys

# Which of Debian's packages brings a library that wheels leave to the system.
DEBIAN_PACKAGES = {
    "libgomp.so.1": "libgomp1",
    "libstdc++.so.6": "libstdc++6",
    "libGL.so.1": "libgl1",
    "libEGL.so.1": "libegl1",
    "libOpenGL.so.0": "libopengl0",
    "libxkbcommon.so.0": "libxkbcommon0",
    "libxkbcommon-x11.so.0": "libxkbcommon-x11-0",
    "libfontconfig.so.1": "libfontconfig1",
    "libdbus-1.so.3": "libdbus-1-3",
    "libglib-2.0.so.0": "libglib2.0-0",
}
QT_BINDINGS = ("PyQt6", "PySide6")


def advice(error: ImportError) -> str:
    """Say which apt package mends an import that failed for want of a shared library."""
    missing = re.search(r"(lib[^\s:]+\.so[.\d]*)", str(error))
    if missing is None:
        return str(error)
    library = missing[1]
    package = DEBIAN_PACKAGES.get(library)
    if package is None:
        return f"{error}\nfind its package by: apt-file search {library}"
    return f"{error}\non Debian or Ubuntu: sudo apt-get install {package}"


def modules() -> list[str]:
    """Return what to load: torch and scikit-image, and a Qt binding where there is one."""
    bindings = [name for name in QT_BINDINGS if importlib.util.find_spec(name) is not None]
    return ["torch", "skimage.metrics", *(f"{name}.QtWidgets" for name in bindings)]


def main() -> int:
    """Load everything; return 1 with advice where something does not load."""
    for name in modules():
        try:
            importlib.import_module(name)
        except ImportError as error:
            sys.stderr.write(f"{name} does not load: {advice(error)}\n")
            return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
