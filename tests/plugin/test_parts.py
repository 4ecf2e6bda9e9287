"""The parts of the plugin that need no window."""

import importlib
import sys

import dask.array as da
import numpy as np
import pytest
import tifffile
from napari.layers import Image, Shapes
from napari.layers._source import Source

from napari_fiberburst.errors import BurstError, FiberBurstError
from napari_fiberburst.plugin.bursts import BurstSource, guess_axes, region_of, source_of
from napari_fiberburst.plugin.calls import as_command, as_python
from napari_fiberburst.plugin.drivers import without_clash
from napari_fiberburst.plugin.history import History, HistoryEntry
from napari_fiberburst.plugin.pace import Pace
from napari_fiberburst.plugin.placement import Placement, as_colour
from napari_fiberburst.plugin.stacks import residual_maps, stabilised
from napari_fiberburst.results.reconstruction import Canvas


def image(*shape, **look):
    return Image(np.zeros(shape, np.uint8), **look)


@pytest.mark.parametrize(
    ("layer", "axes"),
    [
        (image(9, 31, 37), "TYX"),
        (image(9, 31, 37, 3, rgb=True), "TYXC"),
        (image(9, 31, 37, 4, rgb=True), "TYXC"),
        (image(9, 2, 31, 37), "TCYX"),
        (image(2, 9, 31, 37), "CTYX"),
        (image(9, 31, 37, 5), "TYXC"),
        (image(1, 1, 9, 31, 37), "QZTYX"),
        (image(31, 37, 9, axis_labels=("y", "x", "t")), "YXT"),
        (image(31, 37), "YX"),
    ],
)
def test_axes_are_guessed_by_labels_and_shape(layer, axes):
    assert guess_axes(layer) == axes


def test_a_burst_is_the_same_whatever_the_order_of_its_axes(rng):
    frames = rng.integers(0, 255, (5, 31, 37, 2), dtype=np.uint8)
    expected = source_of([Image(frames, rgb=False)], "TYXC").read()
    turned = source_of([Image(frames.transpose(3, 0, 1, 2))], "CTYX")
    np.testing.assert_array_equal(turned.read().frames, expected.frames)
    np.testing.assert_array_equal(turned.frames, frames)
    assert turned.shape == (5, 31, 37, 2)


def test_axes_that_do_not_fit_are_refused():
    with pytest.raises(BurstError, match="correct the order"):
        _ = source_of([image(9, 31, 37)], "TYXC").shape


def test_channels_of_different_shapes_are_refused():
    source = source_of([image(9, 31, 37), image(9, 31, 36)], "TYX")
    with pytest.raises(BurstError, match="one shape"):
        source.read()


def test_an_alpha_channel_is_no_part_of_the_burst(rng):
    frames = rng.integers(0, 255, (5, 31, 37, 4), dtype=np.uint8)
    assert source_of([Image(frames, rgb=True)], "TYXC").read().shape == (5, 31, 37, 3)


def test_a_region_is_read_in_the_worlds_units():
    layer = image(9, 60, 80, scale=(1, 0.5, 2.0), translate=(0, 100, 200))
    # Rows 10 to 39 and columns 20 to 49.
    corners = np.array([[105, 240], [105, 298], [119.5, 298], [119.5, 240]])
    shapes = Shapes([corners], shape_type="rectangle")
    assert region_of(shapes, layer, "TYX") == ((10, 40), (20, 50))


@pytest.mark.parametrize(
    ("corners", "words"),
    [(None, "holds no rectangle"), ([[0, 0], [0, 5], [5, 5], [5, 0]], "at least 16 x 16")],
)
def test_a_region_of_no_use_is_refused(corners, words):
    shapes = Shapes() if corners is None else Shapes([np.array(corners)], shape_type="rectangle")
    with pytest.raises(FiberBurstError, match=words):
        region_of(shapes, image(9, 60, 80), "TYX")


def source(**known) -> BurstSource:
    values = {"names": ("a",), "arrays": (np.zeros((5, 31, 37), np.uint8),), "axes": "TYX", "recipe": {}}
    values["words"] = tuple(f"viewer.layers[{name!r}].data" for name in known.get("names", ("a",)))
    return BurstSource(**{**values, **known})


def test_a_burst_from_a_file_is_called_by_its_path():
    text = as_python(source(path="burst.tif"), {"motion": "affine", "upsample": 2.0})
    assert "reconstruct(\n    'burst.tif',\n    motion='affine',\n    upsample=2.0,\n)" in text
    assert as_command(source(path="my burst.tif"), {"fill": True}) == (
        "fiberburst reconstruct 'my burst.tif' -o image.ome.tif --fill\n"
    )


def test_axes_region_and_channels_are_in_the_call():
    turned = source(path="b.tif", axes="CTYX", region=((1, 20), (2, 30)), arrays=(np.zeros((2, 5, 31, 37)),))
    assert "Burst(viewer.layers['a'].data, axes='CTYX').crop((1, 20), (2, 30))" in as_python(turned, {})
    assert "--axes CTYX --crop 1:20,2:30" in as_command(turned, {})
    several = source(names=("r", "g"), channel_names=("r", "g"), arrays=(np.zeros((5, 31, 37)),) * 2)
    assert (
        "Burst([viewer.layers['r'].data, viewer.layers['g'].data], axes='CTYX', channel_names=('r', 'g'))"
        in as_python(several, {})
    )
    assert as_command(several, {}).startswith("# save layer 'r + g' as burst.tif first\n")


def test_a_simulated_burst_is_simulated_by_its_command():
    text = as_command(source(recipe={"scene": "cat", "physics": "core"}), {"preset": "paper"})
    assert text.splitlines() == [
        "fiberburst simulate --scene cat --physics core -o simulated.burst",
        "fiberburst reconstruct simulated.burst -o image.ome.tif --preset paper",
    ]
    faulty = {"scene": "cat", "deformation_length": 40.0, "overlay": True}
    assert as_command(source(recipe=faulty), {}).startswith(
        "fiberburst simulate --scene cat --deformation-length 40.0 --overlay -o simulated.burst\n"
    )


def test_history_keeps_the_first_the_newest_and_an_even_part_between():
    canvas = Canvas.over((0, 0, 10, 10))
    history = History(most_bytes=10 * 400)
    for number in range(100):
        history.add(HistoryEntry(float(number), np.full((10, 10), number, np.float32), canvas))
        assert history.entries[-1].seconds == number
    seconds = [entry.seconds for entry in history.entries]
    assert len(seconds) <= 10
    assert seconds[0] == 0
    assert len(set(np.diff(seconds[:-1]))) == 1


def test_one_slow_drawing_holds_up_no_more_than_the_next_two():
    pace = Pace(0.1)
    assert pace.is_due(0.0)
    pace.note(0.0, 0.05)
    pace.note(1.0, 4.0)  # the first layer of its kind
    assert pace.is_due(4.5)
    assert not pace.is_due(4.4)
    pace.note(5.0, 5.05)
    assert pace.is_due(5.55)


def test_drawings_that_are_all_slow_come_every_two_seconds():
    pace = Pace(0.1)
    for began in (0.0, 3.0, 6.0):
        pace.note(began, began + 1.0)
        assert not pace.is_due(began + 1.0 + 1.9)
        assert pace.is_due(began + 1.0 + 2.0)


def test_a_turned_layer_has_its_image_in_the_same_place():
    layer = image(9, 31, 37, rotate=30, scale=(1, 2.0, 2.0), translate=(0, 5, 7))
    placement = Placement.of([layer], "TYX", (3, 4))
    canvas = Canvas.over((0, 0, 20, 20), 2.0)
    shown = Image(np.zeros(canvas.shape, np.float32), **placement.on_canvas("YX", canvas))
    for x, y in ((0, 0), (39, 0), (17, 33)):
        frame_x, frame_y, _ = canvas.reference_from_image @ [x, y, 1]
        expected = layer.data_to_world((0, frame_y + 3, frame_x + 4))[-2:]
        np.testing.assert_allclose(shown.data_to_world((y, x)), expected, atol=1e-9)


def test_arrays_are_put_into_the_order_of_the_layers_axes(rng):
    placement = Placement.of([image(2, 9, 31, 37)], "CTYX", (0, 0))
    drawn = rng.random((31, 37, 2))
    shown, axes = placement.arrange(drawn, "YXC")
    assert axes == "CTYX"
    assert shown.shape == (2, 9, 31, 37)
    np.testing.assert_array_equal(shown[1, 4], drawn[..., 1])
    assert placement.arrange(drawn[..., 0], "YX")[1] == "YX"


def test_outlines_follow_every_other_axis():
    placement = Placement.of([image(9, 2, 31, 37)], "TCYX", (0, 0))
    first, second = placement.vertices(np.array([[3.0, 4.0], [5.0, 6.0]]), frame=7)
    np.testing.assert_array_equal(first, [[7, 0, 4, 3], [7, 0, 6, 5]])
    np.testing.assert_array_equal(second, [[7, 1, 4, 3], [7, 1, 6, 5]])


def test_colour_is_see_through_where_nothing_was_seen(tiny_burst):
    drawn = np.full((2, 2, 3), 51.0, np.float32)
    drawn[0, 0, 1] = np.nan
    shown = as_colour(drawn, tiny_burst.acquisition)
    np.testing.assert_allclose(shown[1, 1], [0.2, 0.2, 0.2, 1])
    np.testing.assert_array_equal(shown[0, 0], 0)


def test_stabilised_frames_stand_still():
    """A bright pixel that moves with the motion stays where frame 0 has it."""
    frames = np.zeros((3, 31, 37), np.uint8)
    homographies = np.stack([np.eye(3)] * 3)
    for number, (x, y) in enumerate([(10, 12), (13, 17), (8, 9)]):
        frames[number, y, x] = 200
        homographies[number, :2, 2] = 10 - x, 12 - y
    homographies[2] = np.nan  # left out
    still = stabilised(frames, homographies, Canvas.over((0, 0, 37, 31)))
    assert still.shape == (3, 31, 37)
    for number in (0, 1):
        assert np.unravel_index(still[number].compute().argmax(), (31, 37)) == (12, 10)
    assert still[2].compute().max() == 0


def test_residuals_are_drawn_in_the_pixels_of_their_cores():
    labels = np.full((21, 31), 2, np.int32)
    labels[3:8, 4:9], labels[10:15, 20:25] = 0, 1
    maps = residual_maps(np.array([[1, 2], [3, np.nan]], np.float32), labels)
    assert maps.shape == (2, 21, 31)
    first, second = np.asarray(maps)
    assert (first[3:8, 4:9] == 1).all()
    assert (first[10:15, 20:25] == 2).all()
    assert np.isfinite(first).sum() == 50
    assert np.isfinite(second).sum() == 25


def test_a_dask_burst_is_read_a_frame_at_a_time():
    read = []

    def note(block, block_info):
        read.append(block_info[0]["chunk-location"][0])
        return block

    frames = da.zeros((6, 31, 37), np.uint8, chunks=(1, 31, 37)).map_blocks(
        note, dtype=np.uint8, meta=np.empty((0, 0, 0))
    )
    still = stabilised(frames, np.stack([np.eye(3)] * 6), Canvas.over((0, 0, 37, 31)))
    still[3].compute()
    assert set(read) == {3}


def test_a_file_is_named_only_where_it_reads_as_the_layer(tmp_path):
    path = tmp_path / "burst.tif"
    tifffile.imwrite(path, np.zeros((2, 5, 31, 37), np.uint8))
    whole, channel = image(2, 5, 31, 37), image(5, 31, 37)
    for layer in (whole, channel):
        layer._source = Source(path=str(path))
    assert source_of([whole], "CTYX").path == str(path)
    assert source_of([channel], "TYX").path is None


def test_a_layer_is_called_as_it_must_be_read(rng):
    rgba = Image(rng.random((5, 31, 37, 4)), rgb=True, name="a")
    assert source_of([rgba], "TYXC").words == ("viewer.layers['a'].data[..., :3]",)
    pyramid = Image([rng.random((5, 32, 32)), rng.random((5, 16, 16))], name="b", multiscale=True)
    assert source_of([pyramid], "TYX").words == ("viewer.layers['b'].data[0]",)


@pytest.mark.parametrize(("library", "is_there"), [("libLLVM-15.so.1", False), ("libGLX_nvidia.so.0", True)])
def test_triton_stays_out_where_a_driver_has_its_own_llvm(tmp_path, monkeypatch, library, is_there):
    (tmp_path / "triton.py").write_text("")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "triton", raising=False)
    maps = tmp_path / "maps"
    maps.write_text(f"7f45c5800000-7f45c7000000 r-xp 00000000 08:01 1234 /usr/lib/{library}\n")
    with without_clash(maps):
        if is_there:
            importlib.import_module("triton")
        else:
            with pytest.raises(ModuleNotFoundError, match="triton"):
                importlib.import_module("triton")
    assert importlib.import_module("triton").__file__ == str(tmp_path / "triton.py")
    del sys.modules["triton"]  # not by monkeypatch, which would put it back in the end
