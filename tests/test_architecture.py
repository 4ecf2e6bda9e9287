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
    "results": BASE | {"io", "stored", "bundle", "coordinates", "quality"},
    "operators": BASE | {"coordinates"},
    "bundle": BASE | {"coordinates", "operators", "device", "steps", "stored", "io"},
    "motion": BASE | {"coordinates", "operators", "steps", "stored", "bundle"},
    "scene": BASE | {"coordinates", "operators", "steps", "stored", "bundle", "motion", "quality"},
    "networks": RESULTS | {"coordinates", "operators", "device", "quality", *STEPS},
    "pipeline": RESULTS | {"coordinates", "operators", "device", "steps", "stored", "networks", "memory", *STEPS},
    "recordings": RESULTS | {"coordinates", "operators", "quality", "steps", "stored", "pipeline", *STEPS},
    "live": BASE | {"io", "simulation", "operators", "steps", "bundle", "motion", "pipeline"},
    "report": RESULTS | {"coordinates", "quality"},
    "cli": RESULTS | {"simulation", "quality", "bundle", "networks", "pipeline", "recordings", "report", "live", ""},
    "__main__": {"cli"},
    "memory": BASE,
    "streaming": set(),
    "plugin": RESULTS
    | {
        "simulation",
        "quality",
        "coordinates",
        "bundle",
        "networks",
        "device",
        "pipeline",
        "recordings",
        "report",
        "live",
    }
    | {"memory", "streaming"},
}
TORCH = {"stored", "device", "operators", "bundle", "motion", "scene", "networks", "pipeline", "recordings", "live"}
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


def assigns_to_another(path: Path) -> set[str]:
    """Return the attributes that a file assigns to of anything but `self` or `cls`."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        targets = node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", None)]
        for target in [part for whole in targets for part in (whole.elts if isinstance(whole, ast.Tuple) else [whole])]:
            owner = target
            while isinstance(owner, ast.Subscript | ast.Attribute):
                owner, is_attribute = owner.value, isinstance(owner, ast.Attribute)
                if is_attribute and isinstance(owner, ast.Name) and owner.id not in {"self", "cls"}:
                    found.add(ast.unparse(target))
    return found


def test_nothing_outside_pipeline_and_plugin_reassigns_another_objects_attribute():
    """The steps exchange frozen values: whoever holds one can rely on it.

    The command line sets tqdm's totals; FFmpeg is told when a frame is shown, and the number of a packet in the place
    of its time.
    """
    allowed = {
        "io/video_writer.py": {"frame.pts", "frame.time_base"},
        "io/video_container.py": {"packet.pts", "packet.dts"},
    }
    for part, path in files():
        if part not in {"pipeline", "plugin", "cli"}:
            others = assigns_to_another(path) - allowed.get(path.relative_to(ROOT).as_posix(), set())
            assert not others, f"{path} assigns to {others}"


def test_a_reassigned_attribute_is_noticed(tmp_path):
    for line in ("other.x = 1", "other.x += 1", "self.held, other.x.y = 1, 2", "other.x[3] = 1"):
        (tmp_path / "part.py").write_text(f"def change(self, other):\n    {line}\n", encoding="utf-8")
        assert len(assigns_to_another(tmp_path / "part.py")) == 1
    (tmp_path / "part.py").write_text("def change(self, array):\n    self.x = array[3] = 1\n", encoding="utf-8")
    assert not assigns_to_another(tmp_path / "part.py")
