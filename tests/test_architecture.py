"""The direction of dependency: every import inside the package points down this list."""

import ast
from pathlib import Path

import napari_fiberburst

ROOT = Path(napari_fiberburst.__file__).parent

# Each part may import itself and those named here.
BASE = {"errors", "settings", "control", "data"}
STEPS = {"bundle", "motion", "scene"}
RESULTS = BASE | {"io", "results"}
ALLOWED = {
    "errors": set(),
    "settings": {"errors"},
    "control": {"errors", "settings"},
    "data": {"errors", "coordinates"},
    "coordinates": set(),
    "steps": set(),
    "stored": {"errors", "io"},
    "device": {"errors"},
    "io": BASE,
    "simulation": BASE,
    "quality": BASE,
    "results": BASE | {"io", "bundle"},
    "operators": BASE | {"coordinates"},
    "bundle": BASE | {"coordinates", "operators", "device", "steps", "stored", "io"},
    "motion": BASE | {"coordinates", "operators", "steps", "stored", "bundle"},
    "scene": BASE | {"coordinates", "operators", "steps", "stored", "bundle", "motion", "quality"},
    "networks": RESULTS | {"coordinates", "operators", "device", *STEPS},
    "pipeline": RESULTS | {"coordinates", "operators", "device", "steps", "networks", *STEPS},
    "cli": RESULTS | {"simulation", "quality", "bundle", "networks", "pipeline", ""},
    "memory": BASE,
    "streaming": set(),
    "plugin": RESULTS
    | {"simulation", "quality", "coordinates", "bundle", "networks", "device", "pipeline", "memory", "streaming"},
}
TORCH = {"stored", "device", "operators", "bundle", "motion", "scene", "networks", "pipeline"}
QT = {"qtpy", "magicgui", "superqt", "napari", "pyqtgraph"}


def imported(path: Path) -> set[str]:
    """Return all modules that a file imports, in functions too."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path} imports relatively"
            found |= {f"{node.module}.{alias.name}" for alias in node.names}
    return found


def files():
    for path in sorted(ROOT.rglob("*.py")):
        part = path.relative_to(ROOT).parts[0].removesuffix(".py")
        if part != "__init__":  # the lazy public names
            yield part, path


def test_imports_point_down():
    for part, path in files():
        inside = [name.split(".") for name in imported(path) if name.startswith("napari_fiberburst.")]
        known = {names[1] if names[1] in ALLOWED else "" for names in inside}
        assert known <= ALLOWED[part] | {part}, f"{path} imports {known - ALLOWED[part] - {part}}"


def test_torch_and_qt_stay_where_they_belong():
    for part, path in files():
        outside = {name.split(".")[0] for name in imported(path)}
        assert part in TORCH or "torch" not in outside, f"{path} imports torch"
        assert part == "plugin" or not outside & QT, f"{path} imports {outside & QT}"
