"""Before the tests: load what rests on libraries of the system, and name the package of one that is missing."""

import ctypes
import importlib
import importlib.util
import os
import re
import shutil
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
# What Qt's window on X11 loads only when it opens, and then ends the program for want of.
X11_PACKAGES = {
    "libxcb-cursor.so.0": "libxcb-cursor0",
    "libxcb-icccm.so.4": "libxcb-icccm4",
    "libxcb-image.so.0": "libxcb-image0",
    "libxcb-keysyms.so.1": "libxcb-keysyms1",
    "libxcb-render-util.so.0": "libxcb-render-util0",
    "libxcb-shape.so.0": "libxcb-shape0",
    "libxcb-xinerama.so.0": "libxcb-xinerama0",
    "libxcb-xkb.so.1": "libxcb-xkb1",
    "libxkbcommon-x11.so.0": "libxkbcommon-x11-0",
}
# What opens the documentation's pages, and reports, without a window: Chromium or its kin.
BROWSERS = ("chromium", "chromium-browser", "google-chrome", "chrome", "msedge")
_ELSEWHERE = (
    "/Applications/Google Chrome.app/Contents/MacOS/Google Chrome",
    "C:/Program Files/Google/Chrome/Application/chrome.exe",
)


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


def missing_for_windows() -> list[str]:
    """Return the packages that a window needs and this machine lacks; X11 stands for a display on Linux alone."""
    if not sys.platform.startswith("linux"):
        return []
    missing = []
    for library, package in X11_PACKAGES.items():
        try:
            ctypes.CDLL(library)
        except OSError:
            missing.append(package)
    if shutil.which("Xvfb") is None and "DISPLAY" not in os.environ:
        missing.append("xvfb")
    return missing


def find_browser() -> str | None:
    """Return the browser that opens pages in the tests; None where there is none."""
    found = [path for name in BROWSERS if (path := shutil.which(name))]
    return next(iter([*found, *(path for path in _ELSEWHERE if os.path.exists(path))]), None)


def main() -> int:
    """Load everything; return 1 with advice where something does not load."""
    for name in modules():
        try:
            importlib.import_module(name)
        except ImportError as error:
            sys.stderr.write(f"{name} does not load: {advice(error)}\n")
            return 1
    missing = missing_for_windows()
    if missing:
        sys.stderr.write(
            "the plugin's tests open windows, and lack what those need;\n"
            f"on Debian or Ubuntu: sudo apt-get install {' '.join(missing)}\n"
        )
        return 1
    if find_browser() is None:
        sys.stderr.write(
            "the tests of the documentation and of reports open pages in Chromium or Chrome, and there is neither;\n"
            "on Debian: sudo apt-get install chromium\n"
        )
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
