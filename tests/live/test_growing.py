"""A folder and files that grow, watched on a clock that goes on only when it is told to."""

import os

import numpy as np
import pytest
import tifffile
import zarr
from PIL import Image

from napari_fiberburst import FiberBurstError
from napari_fiberburst.live.clocks import SimulatedClock
from napari_fiberburst.live.growing import Growing


def frame(number):
    """Return a frame (19, 23) of its own number."""
    return np.full((19, 23), number, np.uint8)


class ClockWithEvents(SimulatedClock):
    """Does what is written beside a time when that has come."""

    def __init__(self, events):
        super().__init__()
        self._events = sorted(events.items())

    def wait(self, seconds):
        super().wait(seconds)
        assert self.now() < 60, "nothing comes"
        while self._events and self._events[0][0] <= self.now():
            self._events.pop(0)[1]()


def save(path, number):
    return lambda: Image.fromarray(frame(number)).save(path)


def test_a_folder_hands_out_its_newest_frame_and_then_each_that_is_added(tmp_path):
    for number in (1, 2, 9):
        save(tmp_path / f"f{number}.png", number)()
    (tmp_path / "notes.txt").write_text("no frame")
    source = Growing(
        tmp_path, ClockWithEvents({1.0: save(tmp_path / "f10.png", 10), 2.0: save(tmp_path / "f11.png", 11)})
    )
    seen = [source.latest() for _ in range(3)]
    assert [int(got.frames[0, 0, 0, 0]) for got in seen] == [9, 10, 11]
    assert [got.indices.tolist() for got in seen] == [[0], [1], [2]]
    assert [got.times[0] for got in seen] == pytest.approx([0, 1, 2], abs=0.06)
    assert seen[0].frames.shape == (1, 19, 23, 1)
    assert not any(got.dropped for got in seen)


def test_whoever_comes_late_gets_the_newest(tmp_path):
    source = Growing(tmp_path, ClockWithEvents({}))
    for number in range(5):
        save(tmp_path / f"{number}.png", number)()
    got = source.latest(2)
    assert (got.frames[:, 0, 0, 0].tolist(), got.dropped) == ([3, 4], 3)


def test_a_frame_that_is_still_written_is_waited_for(tmp_path):
    save(tmp_path / "whole.png", 7)()
    whole = (tmp_path / "whole.png").read_bytes()
    half, later = tmp_path / "x1.png", {0.5: lambda: half.write_bytes(whole)}
    (tmp_path / "x1.png").write_bytes(whole[: len(whole) // 2])
    (tmp_path / "whole.png").unlink()
    got = Growing(tmp_path, ClockWithEvents(later)).latest()
    assert (got.frames == 7).all()
    assert 0.4 < got.times[0] < 0.7


def test_a_frame_that_never_gets_whole_is_passed_over(tmp_path):
    source = Growing(tmp_path, ClockWithEvents({1.0: save(tmp_path / "2.png", 2)}))
    (tmp_path / "1.png").write_bytes(b"\x89PNG")
    got = source.latest(64)
    assert (got.frames[0, 0, 0, 0], got.indices.tolist(), got.dropped) == (2, [1], 1)


def test_a_tiff_and_a_zarr_that_grow(tmp_path):
    path = tmp_path / "run.tif"
    tifffile.imwrite(path, frame(0))
    source = Growing(path, ClockWithEvents({1.0: lambda: tifffile.imwrite(path, frame(1), append=True)}))
    assert [int(source.latest().frames[0, 0, 0, 0]) for _ in range(2)] == [0, 1]
    group = zarr.create_group(tmp_path / "run.zarr")
    array = group.create_array("0", shape=(1, 19, 23), chunks=(1, 19, 23), dtype=np.uint8)
    axes = [{"name": "t", "type": "time"}, {"name": "y", "type": "space"}, {"name": "x", "type": "space"}]
    scale = [{"type": "scale", "scale": [1.0, 1.0, 1.0]}]
    scales = [{"axes": axes, "datasets": [{"path": "0", "coordinateTransformations": scale}]}]
    group.attrs["ome"] = {"version": "0.5", "multiscales": scales}
    array[0] = frame(5)

    def grow():
        array.resize((2, 19, 23))
        array[1] = frame(6)

    source = Growing(tmp_path / "run.zarr", ClockWithEvents({1.0: grow}))
    assert [int(source.latest().frames[0, 0, 0, 0]) for _ in range(2)] == [5, 6]


def test_closing_ends_it_and_what_is_gone_is_told(tmp_path):
    source = Growing(tmp_path, ClockWithEvents({}))
    source.close()
    assert len(source.latest().frames) == 0
    path = tmp_path / "run.tif"
    tifffile.imwrite(path, frame(0))
    source = Growing(path, ClockWithEvents({1.0: lambda: os.unlink(path)}))
    source.latest()
    with pytest.raises(FiberBurstError, match="is gone"):
        source.latest()
    with pytest.raises(FiberBurstError, match="is not there; choose a folder"):
        Growing(tmp_path / "none")
