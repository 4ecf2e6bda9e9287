"""Units of work: done once, gone on with, and refused where something else is there."""

import errno
import json
import os
from dataclasses import replace
from pathlib import Path

import pytest
from tests.recordings.same import assert_same

from napari_fiberburst.errors import BurstError, OutputError
from napari_fiberburst.io import open_recording
from napari_fiberburst.recordings.mosaic import mosaic
from napari_fiberburst.recordings.outputs import is_beside
from napari_fiberburst.recordings.work import _handed, _taken, claim, complete, discard, finish, is_begun, own


def note(work, stage, number):
    with (work.folder / "calls").open("a") as calls:
        calls.write(f"{number}\n")


def calls(work):
    path = work.folder / "calls"
    return [int(line) for line in path.read_text().split()] if path.exists() else []


def test_a_unit_that_is_done_is_not_done_again(work):
    assert list(complete(note, "some", work, range(3))) == [(0, 2), (1, 1), (2, 0)]
    assert list(complete(note, "some", work, range(5))) == [(3, 1), (4, 0)]
    assert calls(work) == [0, 1, 2, 3, 4]


@pytest.mark.parametrize("other", ["recording", "bundle", "settings"])
def test_what_was_done_for_something_else_does_not_count(work, other):
    list(complete(note, "some", work, range(2)))
    if other == "recording":
        changed = replace(work, source=replace(work.source, fingerprint="another"))
    elif other == "bundle":
        changed = replace(work, bundle=replace(work.bundle, pitch=work.bundle.pitch + 1))
    else:
        claim(work.folder, {"dof": 4})
        changed = replace(work)
    list(complete(note, "some", changed, range(2)))
    assert calls(work) == [0, 1, 0, 1]


def test_a_half_written_file_is_written_again(work):
    def write(work, stage, number):
        work.path(stage, number).write_text("whole")

    work.path("some", 0).write_text("ha")
    list(complete(write, "some", work, [0]))
    assert work.path("some", 0).read_text() == "whole"


def test_an_error_names_its_unit_and_leaves_it_undone(work):
    def fail(work, stage, number):
        if number == 1:
            raise BurstError("frame 70 cannot be decoded")

    with pytest.raises(BurstError, match=r"^frame 70 cannot be decoded \(some, unit 1\)$"):
        list(complete(fail, "some", work, range(3)))
    assert list(complete(note, "some", work, range(3))) == [(1, 1), (2, 0)]


def test_a_full_disk_is_said_and_the_same_call_goes_on_when_there_is_room(clip, unbroken, tmp_path, monkeypatch):
    source, output = open_recording(clip), tmp_path / "m.ome.zarr"
    room, sync = [12], os.fsync

    def full(descriptor):
        room[0] -= 1
        if room[0] < 0:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        sync(descriptor)

    with monkeypatch.context() as patched:
        patched.setattr(os, "fsync", full)
        with pytest.raises(OutputError, match=r"the disk of .*m\.work is full; make room, and give the same command"):
            mosaic(source, output)
    assert is_begun(tmp_path / "m.work")
    assert not list(tmp_path.rglob("*.part"))
    mosaic(source, output)
    assert_same(tmp_path, unbroken)


def test_other_work_is_refused_and_the_difference_is_named(tmp_path):
    folder = tmp_path / "m.work"
    assert not claim(folder, {"recording": "a", "dof": 2})
    assert claim(folder, {"recording": "a", "dof": 2})
    with pytest.raises(OutputError, match=r"\(dof was 2, is 4\); go on with the same settings .*--fresh"):
        claim(folder, {"recording": "a", "dof": 4})


def test_what_others_have_written_is_neither_replaced_nor_removed(tmp_path):
    folder, mine, theirs = tmp_path / "m.work", tmp_path / "m.ome.zarr", tmp_path / "m-2.ome.zarr"
    claim(folder, {})
    theirs.mkdir()
    own(folder, [mine])
    mine.mkdir()
    own(folder, [mine])
    with pytest.raises(OutputError, match=r"m-2\.ome\.zarr is there already"):
        own(folder, [mine, theirs])
    discard(folder, lambda path: is_beside(mine, path))
    assert sorted(tmp_path.iterdir()) == [theirs]


def test_beginning_anew_removes_nothing_else_whatever_a_folder_says(tmp_path):
    folder, output = tmp_path / "m.work", tmp_path / "m.ome.zarr"
    kept = [
        tmp_path / "thesis.txt",
        tmp_path / "m.txt",
        tmp_path / "elsewhere" / "m.ome.zarr",
        tmp_path / "n.poses.csv",
    ]
    gone = [tmp_path / name for name in ("m.poses.csv", "m-3.ome.zarr", "m.traces.csv")]
    claim(folder, {})
    (tmp_path / "elsewhere").mkdir()
    for path in [*kept, *gone]:
        path.write_text("mine")
    (folder / "outputs.json").write_text(json.dumps([str(path) for path in [*kept, *gone, output]]))
    discard(folder, lambda path: is_beside(output, path))
    assert all(path.exists() for path in kept)
    assert not any(path.exists() for path in gone)
    assert not is_begun(folder)


def test_what_a_worker_is_handed_is_taken_only_as_it_was_written(work):
    handed = _handed(work)
    assert _taken(handed).folder == work.folder
    Path(handed).write_bytes(Path(handed).read_bytes()[:-1] + b"?")
    _taken.cache_clear()
    with pytest.raises(OutputError, match="was altered since this run wrote it"):
        _taken(handed)


def test_a_finished_mosaic_is_not_replaced(clip, unbroken):
    with pytest.raises(OutputError, match=r"m\.ome\.zarr is there already; .* --overwrite"):
        mosaic(open_recording(clip), unbroken / "m.ome.zarr")
    assert sorted(path.name for path in unbroken.iterdir()) == ["m.ome.zarr", "m.poses.csv"]


def test_work_that_ends_in_the_middle_of_removing_its_folder_is_done(tmp_path):
    folder = tmp_path / "m.work"
    claim(folder, {})
    (tmp_path / ".m.work.gone").mkdir()  # from a run that was killed
    finish(folder)
    assert not list(tmp_path.iterdir())
