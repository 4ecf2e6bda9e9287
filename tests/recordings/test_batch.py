"""A batch: a row for every recording, whether it fails or not."""

import csv
import json
import os
from dataclasses import replace

import numpy as np
import pytest
import tifffile
import zarr

from napari_fiberburst.cli import main
from napari_fiberburst.errors import BurstError, SettingsError
from napari_fiberburst.io import open_recording
from napari_fiberburst.recordings import tasks
from napari_fiberburst.recordings.batch import read_settings, recordings_in
from napari_fiberburst.report.batch import write_batch
from napari_fiberburst.results.batch import Row


@pytest.fixture
def folder(clip, tmp_path):
    """Return a folder of two recordings that can be used, one that is broken, and what is none."""
    folder = tmp_path / "clips"
    folder.mkdir()
    (folder / "clip 10.mkv").write_bytes(clip.read_bytes())
    frames = open_recording(clip).recorded(range(30))[..., 0]
    tifffile.imwrite(folder / "clip 9.tif", frames, photometric="minisblack")
    (folder / "broken.avi").write_bytes(b"nothing")
    (folder / "notes.txt").write_text("none")
    return folder


def table_of(output):
    with (output / "table.csv").open(newline="") as table:
        return list(csv.DictReader(table))


def test_recordings_are_found_in_natural_order(folder):
    (folder / "frames").mkdir()
    (folder / "frames" / "1.png").touch()
    names = [path.name for path in recordings_in(folder)]
    assert names == ["broken.avi", "clip 9.tif", "clip 10.mkv", "frames"]
    assert "frames" not in [path.name for path in recordings_in(folder, folder / "frames")]
    with pytest.raises(BurstError, match="has no recordings"):
        recordings_in(folder / "frames")
    with pytest.raises(BurstError, match="there is no folder"):
        recordings_in(folder / "nowhere")


def test_one_that_fails_does_not_stop_the_others_and_is_tried_again(folder, tmp_path, capsys, monkeypatch):
    output = tmp_path / "out"
    words = ["batch", str(folder), "--task", "mosaic", "-o", str(output)]
    assert main(words) == 1
    assert "2 of 3 recordings are done" in capsys.readouterr().out
    rows = table_of(output)
    assert [(row["recording"], row["verdict"]) for row in rows] == [
        ("broken.avi", "failed"),
        ("clip 9.tif", "good"),
        ("clip 10.mkv", "good"),
    ]
    assert "broken.avi" in rows[0]["notes"]
    assert rows[1]["facts"].startswith("30 of 30 frames in the picture")
    picture = zarr.open_array(output / "clip 9.tif" / "mosaic.ome.zarr" / "0", mode="r")
    assert np.isfinite(np.asarray(picture)).mean() > 0.5
    page = (output / "report.html").read_text(encoding="utf-8")
    assert page.count("data:image/png;base64,") == 2
    assert 'href="clip%209.tif/mosaic.ome.zarr"' in page

    opened = []

    def only_opened(source, *more, **settings):
        opened.append(source.name)
        raise BurstError("not asked for")

    (folder / "broken.avi").unlink()
    monkeypatch.setattr(tasks, "mosaicking", only_opened)
    assert main(words) == 0
    assert not opened
    assert [row["verdict"] for row in table_of(output)] == ["good", "good"]


def test_a_batch_of_videos_has_a_video_and_a_film_of_each(folder, tmp_path):
    (folder / "broken.avi").unlink()
    (folder / "clip 10.mkv").unlink()
    settings = tmp_path / "batch.toml"
    settings.write_text("[video]\nwindow = 5\nmp4 = true\n")
    output = tmp_path / "out"
    words = ["batch", str(folder), "--task", "video", "-o", str(output), "--settings", str(settings)]
    assert main(words) == 0
    (row,) = table_of(output)
    assert row["verdict"] == "good"
    assert row["facts"].startswith("30 of 30 frames have a place; 5 frames stand behind each")
    made = output / "clip 9.tif"
    assert zarr.open_array(made / "video.ome.zarr" / "0", mode="r").shape == (30, 97, 121)
    assert len(open_recording(made / "video.mp4")) == 30
    assert (made / "thumbnail.png").stat().st_size > 500


def test_a_row_is_called_no_better_than_its_mosaic_calls_itself(folder, tmp_path, monkeypatch):
    """As many frames as are said to have a place, of the three with the same picture."""
    expected = {"clip a.mkv": (40, "doubtful"), "clip b.mkv": (30, "doubtful"), "clip c.mkv": (9, "bad")}
    for name in ("broken.avi", "clip 9.tif"):
        (folder / name).unlink()
    clip = (folder / "clip 10.mkv").rename(folder / "clip a.mkv")
    for name in ("clip b.mkv", "clip c.mkv"):
        (folder / name).write_bytes(clip.read_bytes())
    whole, first = tasks.mosaicking, []

    def doubted(source, path, **named):
        if not first:
            first.append((yield from whole(source, path, **named)))
        (made,) = first
        placed, _ = expected[path.parent.name]
        piece = np.where(np.arange(len(made.track)) < placed, 0, -1)
        return replace(made, track=replace(made.track, piece=piece), quality="doubtful")

    monkeypatch.setattr(tasks, "mosaicking", doubted)
    assert main(["batch", str(folder), "--task", "mosaic", "-o", str(tmp_path / "out")]) == 0
    rows = {row["recording"]: row["verdict"] for row in table_of(tmp_path / "out")}
    assert rows == {name: verdict for name, (_, verdict) in expected.items()}


def test_a_batch_of_bursts_has_an_image_of_each(folder, tmp_path):
    (folder / "broken.avi").unlink()
    (folder / "clip 10.mkv").unlink()
    settings = tmp_path / "batch.toml"
    settings.write_text("[burst]\nframes = 8\nmotion = 'translation'\n[mosaic]\nmotion = 'similarity'\n")
    output = tmp_path / "out"
    words = ["batch", str(folder), "--task", "burst", "-o", str(output), "--settings", str(settings)]
    assert main(words) == 0
    image = tifffile.imread(output / "clip 9.tif" / "image.ome.tif")
    assert image.ndim == 2
    told = json.loads((output / "clip 9.tif" / "image.json").read_text())
    assert told["settings"]["method"]["motion"]["name"] == "translation"
    (row,) = table_of(output)
    assert row["verdict"] in {"good", "doubtful", "bad"}
    assert row["outputs"] == "clip 9.tif/image.ome.tif"


def test_settings_are_checked_before_anything_is_opened(tmp_path):
    file = tmp_path / "batch.toml"
    os.mkfifo(file)
    with pytest.raises(SettingsError, match=r"cannot be read as TOML \(it is no file\)"):
        read_settings(file, "mosaic")
    file.unlink()
    for text, said in (
        ("[mosaic", "cannot be read as TOML"),
        (f"deep = {'[' * 5000}{']' * 5000}", "cannot be read as TOML"),
        ("[movie]", r"movie .* is no table that is known; expected \[recording\], \[mosaic\], \[video\], \[burst\]"),
        ("[mosaic]\nspeed = 1", "speed is no setting of a mosaic"),
        ("[mosaic]\nmotion = 'wild'", "motion must be one of auto, translation, similarity"),
        ("[recording]\nlevels = 1", "expected axes, black_level, white_level"),
    ):
        file.write_text(text)
        with pytest.raises(SettingsError, match=said):
            read_settings(file, "mosaic")
    for text, said in (
        ("window = 0", "window must be a number of frames, at least 1; got 0"),
        ("stabilised = 1", "stabilised must be true or false; got 1"),
        ("regions = 'x.tif'", r"regions must be a label image, or a folder of one for each recording; got .*x\.tif"),
        ("scale_bar = 2", "scale_bar must be true or false; got 2"),
        ("scale_bar = true", "scale_bar is drawn into a film, and none is asked for"),
        ("speed = 1", "speed is no setting of a video; known ones are bundle, motion, window, stabilised, regions"),
    ):
        file.write_text(f"[video]\n{text}")
        with pytest.raises(SettingsError, match=said):
            read_settings(file, "video")
    file.write_text("[burst]\nsmoothnes = 1")
    with pytest.raises(SettingsError, match="smoothnes"):
        read_settings(file, "burst")
    file.write_text("[mosaic]\nbundle = 'probe.bundle'")
    assert read_settings(file, "mosaic")["mosaic"]["bundle"] == str(tmp_path / "probe.bundle")
    given = {"motion": "translation", "bundle": "/probe"}
    assert read_settings(file, "mosaic", given)["mosaic"] == given


def test_videos_of_a_batch_have_what_the_command_line_asks_for(folder, tmp_path, capsys):
    for name in ("broken.avi", "clip 10.mkv"):
        (folder / name).unlink()
    frames = tifffile.imread(folder / "clip 9.tif")[:8]
    tifffile.imwrite(folder / "clip 11.tif", frames, photometric="minisblack")
    (folder / "clip 9.tif").rename(tmp_path / "whole.tif")
    sized = {"axes": "TYX", "PhysicalSizeX": 0.5, "PhysicalSizeY": 0.5}
    tifffile.imwrite(folder / "clip 9.ome.tif", frames, photometric="minisblack", metadata=sized)
    regions = tmp_path / "regions"
    regions.mkdir()
    tifffile.imwrite(regions / "clip 11.tif", np.pad(np.full((20, 30), 7, np.uint8), ((30, 47), (40, 51))))
    (tmp_path / "batch.toml").write_text("[video]\nwindow = 9\nmotion = 'translation'\n")
    words = ["batch", str(folder), "--task", "video", "-o", str(tmp_path / "out")]
    given = ["--settings", str(tmp_path / "batch.toml"), "--window", "5", "--mp4", "--scale-bar"]
    assert main([*words, *given, "--regions", str(regions)]) == 0
    without, with_regions = table_of(tmp_path / "out")
    assert all("5 frames stand behind each" in row["facts"] for row in (without, with_regions))
    assert "clip 11.tif/video.traces.csv" in with_regions["outputs"]
    assert (tmp_path / "out" / "clip 11.tif" / "video.traces.csv").read_text().startswith("frame,seconds,region_7")
    assert "without regions, because there is no" in without["notes"]
    film = open_recording(tmp_path / "out" / "clip 9.ome.tif" / "video.mp4").recorded([7])[0, ..., 0]
    # The bar: of 30.25 pixels at most, 10 micrometres are 20.
    assert (film[80:, 70:] > 235).sum(axis=1).max() >= 20
    assert main([*words[:3], "mosaic", "-o", str(tmp_path / "m"), "--window", "5"]) == 2
    assert "window is no setting of a mosaic" in capsys.readouterr().err


def test_another_batch_and_other_files_are_left_alone(folder, tmp_path, capsys):
    output = tmp_path / "out"
    output.mkdir()
    (output / "mine.txt").touch()
    words = ["batch", str(folder), "--task", "mosaic", "-o", str(output)]
    assert main(words) == 2
    assert "holds something else, such as mine.txt" in capsys.readouterr().err
    (output / "work.json").write_text(json.dumps({"task": "burst", "settings": {}}))
    assert main(words) == 2
    assert "task was 'burst', is 'mosaic'" in capsys.readouterr().err


def test_a_full_disk_stops_the_batch(folder, tmp_path, capsys, monkeypatch):
    def full(*given, **settings):
        raise OSError(28, "No space left on device")
        yield

    monkeypatch.setattr(tasks, "mosaicking", full)
    (folder / "broken.avi").unlink()
    assert main(["batch", str(folder), "--task", "mosaic", "-o", str(tmp_path / "out")]) == 2
    assert "is full; make room" in capsys.readouterr().err


def test_names_are_text_in_the_page(tmp_path):
    write_batch(tmp_path / "report.html", [Row(name="<b>.avi", verdict="failed", notes=("a < b",))], "clips & more")
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert "&lt;b&gt;.avi" in page
    assert "a &lt; b" in page
    assert "<title>clips &amp; more</title>" in page


def test_a_batch_that_was_killed_before_a_row_goes_on_and_fresh_begins_anew(folder, tmp_path, capsys):
    (folder / "broken.avi").unlink()
    output = tmp_path / "out"
    settings = tmp_path / "batch.toml"
    settings.write_text("[burst]\nframes = 6\nmotion = 'translation'\niterations = 1\n")
    words = ["batch", str(folder), "--task", "burst", "-o", str(output), "--settings", str(settings)]
    assert main(words) == 0
    (output / "clip 9.tif" / "row.json").unlink()
    (output / "mine.txt").write_text("stays")
    kept = (output / "clip 10.mkv" / "image.ome.tif").stat().st_mtime_ns
    assert main(words) == 0
    assert (output / "clip 9.tif" / "row.json").exists()
    assert (output / "clip 10.mkv" / "image.ome.tif").stat().st_mtime_ns == kept
    settings.write_text("[burst]\nframes = 5\nmotion = 'translation'\niterations = 1\n")
    capsys.readouterr()
    assert main(words) != 0
    assert "--fresh" in capsys.readouterr().err
    assert main([*words, "--fresh"]) == 0
    assert (output / "clip 10.mkv" / "image.ome.tif").stat().st_mtime_ns != kept
    assert (output / "mine.txt").read_text() == "stays"
