"""Any image layer with a time axis is saved as a film, as it is shown, while the window stays free."""

import sys
import threading

import dask.array as da
import numpy as np
import pytest
import zarr
from napari.layers import Image, Labels
from napari.utils import cancelable_progress, progress
from napari.utils.notifications import notification_manager
from npe2 import PluginManifest
from qtpy.QtWidgets import QFileDialog

from napari_fiberburst.io import open_recording
from napari_fiberburst.io.video_writer import write_video
from napari_fiberburst.plugin import commands, film
from napari_fiberburst.plugin.bursts import guess_axes
from napari_fiberburst.plugin.contributions import read

MILLISECONDS = 30_000
# H.264 is not exact, and the film's sides are even.
TOLERANCE = 3.0


def said():
    return notification_manager.records[-1].message


@pytest.fixture
def frames():
    """Return 6 frames of odd sides that grow brighter to the right and in time, (6, 61, 83) float32."""
    rising = np.linspace(100, 900, 83) + np.linspace(0, 50, 61)[:, None] + 100 * np.arange(6)[:, None, None]
    return rising.astype(np.float32)


@pytest.fixture
def saved(make_napari_viewer, monkeypatch, tmp_path, qtbot):
    """Return a function that adds layers, selects them, and saves a film by the command; returns its frames."""
    viewer = make_napari_viewer()

    def save(*layers, name="film.mp4"):
        for layer in layers:
            viewer.add_layer(layer)
        viewer.layers.selection = set(layers)
        monkeypatch.setattr(QFileDialog, "getSaveFileName", lambda *_: (str(tmp_path / name), ""))
        commands.save_film()
        qtbot.waitUntil(lambda: not film._GOING, timeout=MILLISECONDS)
        path = tmp_path / name
        return open_recording(path).recorded(range(6)) if said() == f"wrote {path}" else None

    return save


def shown_at(values, low, high):
    """Return what a screen shows of values, 0 to 255."""
    return np.clip(255 * (values - low) / (high - low), 0, 255)


def close(made, expected):
    assert np.abs(made[:, :61, :83].astype(float) - expected).mean() < TOLERANCE


def test_a_layer_is_saved_at_the_contrast_that_the_user_has_set(saved, frames):
    made = saved(Image(frames, name="stack", contrast_limits=(400, 1000)))
    close(made[..., 0], shown_at(frames, 400, 1000))


@pytest.mark.parametrize("kind", ["dask", "zarr", "multiscale", "with_nan"])
def test_a_stack_that_is_not_in_memory_at_one_scale_and_known_is_saved_too(saved, frames, kind, tmp_path):
    expected = shown_at(frames, 200, 1200)
    stored = zarr.create_array(tmp_path / "a.zarr", shape=frames.shape, dtype="f4", chunks=(1, 61, 83))
    stored[:] = frames
    data = {
        "dask": da.from_array(frames, chunks=(4, 61, 83)),
        "zarr": stored,
        "multiscale": [frames, frames[:, ::2, ::2]],
        "with_nan": frames.copy(),
    }[kind]
    if kind == "with_nan":
        data[:, :, 70:] = np.nan
        expected[:, :, 70:] = 0
    made = saved(Image(data, multiscale=kind == "multiscale", contrast_limits=(200, 1200), name=kind))
    close(made[..., 0], expected)


def test_colours_are_saved_as_they_are_shown(saved, frames):
    red = shown_at(frames, 0, 2000)
    colours = np.stack([red, 255 - red, 0 * red + 40], axis=-1)
    see_through = np.concatenate([colours / 255, np.ones((6, 61, 83, 1))], axis=-1).astype(np.float32)
    for number, data in enumerate([colours.astype(np.uint8), see_through]):
        made = saved(Image(data, rgb=True, name=f"colours {number}"), name=f"{number}.mkv")
        close(made, colours)


def test_channels_of_one_layer_are_saved_as_their_mean(saved, frames):
    channels = np.stack([frames, 0 * frames + 500], axis=1)
    made = saved(Image(channels, axis_labels=("t", "c", "y", "x"), contrast_limits=(0, 1400), name="two channels"))
    close(made[..., 0], shown_at(channels.mean(axis=1), 0, 1400))


@pytest.mark.parametrize("as_affine", [False, True])
def test_the_scale_bar_is_that_of_the_layer(saved, frames, as_affine):
    placed = {"affine": np.diag([1, 0.5, 0.5, 1])} if as_affine else {"scale": (1, 0.5, 0.5)}
    still = Image(0 * frames, contrast_limits=(0, 1), units=("pixel", "um", "um"), name="still", **placed)
    made = saved(still, name="film.mkv")
    # A quarter of 83 pixels of half a micrometre is 10.4: the bar is 10 long.
    rows, columns = np.nonzero(made[3, ..., 0] == 255)
    assert (np.ptp(rows) + 1, np.ptp(columns) + 1) == (2, 20)


def test_a_layer_without_a_length_has_no_scale_bar(saved, frames):
    assert not saved(Image(0 * frames, contrast_limits=(0, 1), name="still"), name="film.mkv").any()


def test_a_recording_keeps_its_times(saved, frames, tmp_path):
    clip = tmp_path / "clip.mkv"
    source = open_recording(np.tile(shown_at(frames, 0, 2000).astype(np.uint8), (9, 1, 1)))
    write_video(source, clip, rate=7.0)
    ((data, look, _),) = read(str(clip))
    saved(Image(data, **look))
    assert len(open_recording(tmp_path / "film.mp4")) == 54
    np.testing.assert_allclose(np.diff(open_recording(tmp_path / "film.mp4").acquisition.times), 1 / 7, atol=1e-3)


def test_axes_that_were_corrected_in_the_dock_hold(open_dock, frames, monkeypatch, tmp_path, qtbot):
    channels = np.stack([frames] * 9, axis=1)  # would be taken for 9 frames of 6 channels
    _, dock = open_dock(Image(channels, name="burst"))
    dock.input.axes.setText("TCYX")
    monkeypatch.setattr(QFileDialog, "getSaveFileName", lambda *_: (str(tmp_path / "a.mp4"), ""))
    commands.save_film()
    qtbot.waitUntil(lambda: "wrote" in said(), timeout=MILLISECONDS)
    assert len(open_recording(tmp_path / "a.mp4")) == 6


def test_what_makes_no_film_is_said_and_nobody_is_asked_where_to(saved, frames, monkeypatch, tmp_path):
    def never(*_):
        raise AssertionError

    stack = Image(frames, name="stack")
    for layers, words in (
        ((), "no layer is selected; select one image layer with a time axis"),
        ((stack, Image(frames)), "2 layers are selected, and a film shows one"),
        ((Labels(np.zeros((6, 61, 83), int), name="cells"),), "'cells' is a layer of labels, not an image"),
        ((Image(frames[0], name="one"),), "layer 'one' has no time axis, its axes are YX; select one that has"),
        ((Image(frames[:1], name="one"),), "layer 'one' has one frame; a film needs a time axis of two or more"),
        (
            (Image(frames[:, None].repeat(3, 1), axis_labels=("t", "z", "y", "x"), name="deep"),),
            "no film can be made of layer 'deep': axis Z of TZYX must have length 1, got 3",
        ),
    ):
        monkeypatch.setattr(QFileDialog, "getSaveFileName", never)
        film.ask_and_save(layers, guess_axes)
        assert words in said()
    monkeypatch.setitem(sys.modules, "av", None)
    film.ask_and_save([stack], guess_axes)
    assert said().startswith("saving a film needs the package av; install it by: pip install")


def test_a_file_is_replaced_only_where_the_dialog_has_asked(saved, frames, tmp_path):
    there = tmp_path / "there.mp4"
    there.write_bytes(b"mine")
    stack = Image(frames, name="stack")
    # The dialog was given "there", and has asked nothing of there.mp4.
    assert saved(stack, name="there") is None
    assert said() == f"{there} is there already; choose it itself to replace it, or another name"
    assert there.read_bytes() == b"mine"
    assert saved(name="there.mp4") is None  # nothing is selected
    assert len(saved(Image(frames, name="again"), name="there.mp4")) == 6


def test_a_film_does_not_replace_what_it_is_made_from(saved, frames, tmp_path):
    clip = tmp_path / "clip.mp4"
    write_video(open_recording(np.tile(shown_at(frames, 0, 2000).astype(np.uint8), (9, 1, 1))), clip)
    before = clip.read_bytes()
    ((data, look, _),) = read(str(clip))
    assert saved(Image(data, **look), name="clip.mp4") is None
    assert said() == f"{clip} is what the film is made from, and would be lost; choose another name"
    assert clip.read_bytes() == before


def test_another_ending_is_said(saved, frames, tmp_path):
    assert saved(Image(frames), name="film.gif") is None
    assert said().startswith("a video file ends in .avi, .mkv, .mp4; got")


class Slow:
    """A stack whose fifth frame is held back, from when that is wanted, until it is let go."""

    shape, dtype, ndim = (200, 61, 83), np.dtype(np.uint8), 3

    def __init__(self):
        self.is_held, self.may_go_on = False, threading.Event()
        self.threads = set()

    def __getitem__(self, key):
        first = key[0] if isinstance(key, tuple) else key
        if self.is_held and isinstance(first, slice) and first.start == 4:
            self.threads.add(threading.get_ident())
            assert self.may_go_on.wait(20)
        return np.zeros(self.shape, np.uint8)[key]


@pytest.fixture
def slow(make_napari_viewer, monkeypatch, tmp_path):
    """Return a stack that is being saved as a film, and the file."""
    path = tmp_path / "slow.mp4"
    monkeypatch.setattr(QFileDialog, "getSaveFileName", lambda *_: (str(path), ""))
    viewer, stack = make_napari_viewer(), Slow()
    viewer.add_image(stack, contrast_limits=(0, 255), multiscale=False)
    stack.is_held = True
    commands.save_film()
    return stack, path


def test_a_long_film_leaves_the_window_free_and_says_how_far_it_is(slow, qtbot):
    stack, path = slow
    assert "at the bottom right, tell how far it is" in said()
    (bar,) = progress._all_instances
    assert bar.total == 200
    qtbot.waitUntil(lambda: bool(stack.threads), timeout=MILLISECONDS)
    assert threading.get_ident() not in stack.threads
    commands.save_film()  # to the same place
    assert said() == f"{path} is being written just now; choose another name, or wait for its end"
    qtbot.waitUntil(lambda: 0 < bar.n < 200, timeout=MILLISECONDS)
    stack.may_go_on.set()
    qtbot.waitUntil(lambda: said() == f"wrote {path}", timeout=MILLISECONDS)
    assert not progress._all_instances
    assert len(open_recording(path)) == 200


def test_a_film_can_be_cancelled_and_leaves_no_file(slow, qtbot):
    stack, path = slow
    (bar,) = progress._all_instances
    assert isinstance(bar, cancelable_progress)  # which has a button for it
    bar.cancel()
    stack.may_go_on.set()
    qtbot.waitUntil(lambda: said() == f"{path} was not written: cancelled", timeout=MILLISECONDS)
    assert not list(path.parent.glob("*"))


def test_the_command_is_in_the_palette_and_in_the_file_menu():
    manifest = PluginManifest.from_distribution("napari-fiberburst")
    told = {command.id: command for command in manifest.contributions.commands}["napari-fiberburst.film"]
    assert (told.title, told.python_name) == ("Save film…", "napari_fiberburst.plugin.commands:save_film")
    assert manifest.contributions.menus["napari/file/io_utilities"][0].command == told.id
