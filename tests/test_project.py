"""The project's own files agree with one another."""

from pathlib import Path

import npe2

import napari_fiberburst

ROOT = Path(__file__).parents[1]


def test_the_manifest_is_valid_and_found():
    manifest = npe2.PluginManifest.from_file(Path(napari_fiberburst.__file__).with_name("napari.yaml"))
    assert manifest.name == "napari-fiberburst"
    inside = Path("src/napari_fiberburst/napari.yaml")
    # Where git makes no links, as on Windows, the file holds the link's target.
    assert (ROOT / "napari.yaml").read_text() in ((ROOT / inside).read_text(), inside.as_posix())


def test_the_version_is_the_same_everywhere():
    version = napari_fiberburst.__version__
    assert f"## {version}" in (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    assert f"version: {version}" in (ROOT / "CITATION.cff").read_text(encoding="utf-8")
