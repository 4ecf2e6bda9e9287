"""Reconstruction and Canvas: where images lie, at any size."""

import json
import os
import struct
import zipfile
from dataclasses import replace

import numpy as np
import pytest

from napari_fiberburst import load, reconstruct
from napari_fiberburst.data.canvas import Canvas
from napari_fiberburst.errors import FiberBurstError, OutputError, SettingsError
from napari_fiberburst.simulation import simulate


def test_a_canvas_at_scale_1_is_the_frame():
    canvas = Canvas.over((0, 0, 37, 31))
    assert canvas.shape == (31, 37)
    np.testing.assert_array_equal(canvas.reference_from_image, np.eye(3))
    np.testing.assert_array_equal(canvas.points()[4, 6], [6, 4])


def test_upsampling_by_two_puts_pixel_0_at_minus_a_quarter():
    canvas = Canvas.over((0, 0, 37, 31), 2)
    assert canvas.shape == (62, 74)
    np.testing.assert_allclose(canvas.points()[0, 0], [-0.25, -0.25])
    np.testing.assert_allclose(canvas.points()[-1, -1], [36.25, 30.25])


def test_bounds_are_half_open_and_may_leave_the_frame():
    canvas = Canvas.over((-3, 5, 4, 9))
    assert canvas.shape == (4, 7)
    np.testing.assert_allclose(canvas.points()[0, 0], [-3, 5])
    np.testing.assert_allclose(canvas.points()[-1, -1], [3, 8])


def test_a_scale_that_does_not_divide_still_covers_the_bounds():
    canvas = Canvas.over((0, 0, 37, 31), 0.3)
    assert canvas.shape == (9, 11)
    points, step = canvas.points(), np.diag(canvas.reference_from_image)[:2]
    np.testing.assert_allclose(points[0, 0] - step / 2, [-0.5, -0.5])
    np.testing.assert_allclose(points[-1, -1] + step / 2, [36.5, 30.5])


@pytest.mark.parametrize(
    ("bounds", "scale"),
    [
        ((0, 0, 0, 5), 1),
        ((3, 0, 2, 5), 1),
        ((0, 0, 5, 5), 0),
        ((0, 0, 5, np.inf), 1),
        ((0, 0, 5), 1),
        ("abcd", 1),
        ((0, 0, 5, 5), "2"),
        ((0, 0, 5, 5), 1e9),
    ],
)
def test_empty_canvases_are_refused(bounds, scale):
    with pytest.raises(SettingsError, match="must be"):
        Canvas.over(bounds, scale)


@pytest.fixture(scope="module")
def result(fit, tiny_burst):
    return fit(tiny_burst, iterations=60, learning_rate=3e-3)


@pytest.fixture(scope="module")
def flowing(fit, tiny_burst):
    return fit(tiny_burst, iterations=60, learning_rate=3e-3, motion="flow", flow_omega_0=3.0)


def test_the_image_is_frame_0_and_the_default_rendering(result):
    np.testing.assert_array_equal(result.image, result.frame(0))
    np.testing.assert_array_equal(result.image, result.render())


def test_a_part_is_drawn_as_in_the_whole(result):
    np.testing.assert_allclose(result.render(bounds=(5, 7, 20, 30)), result.image[7:30, 5:20], atol=0.01)


def test_a_finer_drawing_is_the_same_image(result):
    fine = result.render(scale=3)
    assert fine.shape == (93, 111, 3)
    np.testing.assert_allclose(fine[1::3, 1::3], result.image, atol=0.01)  # the middle of three is the pixel's centre


def test_drawing_beyond_the_frame_is_possible(result):
    wide = result.render(bounds=(-4, -3, 41, 34))
    assert wide.shape == (37, 45, 3)
    np.testing.assert_allclose(wide[3:-3, 4:-4], result.image, atol=0.01)


def test_large_drawings_are_made_of_the_same_chunks(result):
    big = result.render(scale=7)  # more points than are drawn at a time
    np.testing.assert_allclose(big[3::7, 3::7], result.image, atol=0.01)


def test_frames_see_the_scene_where_their_homography_says(result):
    shift = result.homographies[3]
    assert np.abs(shift - np.eye(3)).max() > 1e-4
    mapped = shift @ [20, 11, 1]
    x, y = mapped[:2] / mapped[2]
    seen = result.render(bounds=(x, y, x + 1, y + 1))  # one pixel, centred on (x, y)
    np.testing.assert_allclose(result.frame(3)[11, 20], seen[0, 0], rtol=1e-3, atol=0.05)


def test_flow_of_homographies_is_their_displacement(result):
    flow = result.flow(4)
    assert flow.shape == (31, 37, 2)
    mapped = result.homographies[4] @ [30, 8, 1]
    np.testing.assert_allclose(flow[8, 30], mapped[:2] / mapped[2] - [30, 8], atol=1e-3)
    np.testing.assert_array_equal(result.flow(0), 0)


def test_flow_points_at_what_frame_0_shows(flowing):
    flow = flowing.flow(4)
    np.testing.assert_array_equal(flowing.flow(0), 0)
    assert np.abs(flow[15, 18]).max() > 0.01
    x, y = np.array([18, 15]) + flow[15, 18]
    seen = flowing.render(bounds=(x, y, x + 1, y + 1))
    np.testing.assert_allclose(flowing.frame(4)[15, 18], seen[0, 0], atol=0.5)


def test_frames_are_numbered_as_in_python(result):
    np.testing.assert_array_equal(result.frame(-1), result.frame(4))
    for t in (5, -6):
        with pytest.raises(IndexError, match="of a burst of 5"):
            result.frame(t)


def test_frame_numbers_are_whole(result):
    np.testing.assert_array_equal(result.frame(np.int64(2)), result.frame(2))
    with pytest.raises(TypeError):
        result.frame(1.0)


def test_bounds_may_be_an_array(result):
    np.testing.assert_array_equal(result.render(bounds=np.array([0, 0, 37, 31])), result.image)


def test_compression_counts_bytes_as_they_came(result):
    assert result.compression == 1 - 4 * result.parameters / (5 * 31 * 37 * 3)
    assert result.parameters == sum(parameter.numel() for parameter in result.renderer.field.parameters())


def test_provenance_is_json(result):
    told = json.loads(json.dumps(result.provenance()))
    assert told["seed"] == 0
    assert told["settings"]["method"]["encoding"]["name"] == "fourier"
    assert np.shape(told["homographies"]) == (5, 3, 3)
    assert len(told["losses"]) == 60


def test_homographies_that_say_nothing_are_none_in_json(result):
    unknown = result.homographies.copy()
    unknown[2] = np.nan
    told = json.loads(json.dumps(replace(result, homographies=unknown).provenance(), allow_nan=False))
    assert told["homographies"][2] == [[None] * 3] * 3
    assert told["homographies"][0] == np.eye(3).tolist()


def test_it_is_told_in_a_line(result):
    assert repr(result).startswith("Reconstruction(")
    assert len(repr(result)) < 100


def test_a_saved_representation_draws_the_same_image(result, tmp_path):
    path = result.save(tmp_path / "scene.npz")
    again = load(path, device="cpu")
    np.testing.assert_array_equal(again.image, result.image)
    np.testing.assert_array_equal(again.homographies, result.homographies)
    np.testing.assert_array_equal(again.losses, result.losses)
    assert again.settings == result.settings
    assert again.acquisition.to_dict() == result.acquisition.to_dict()
    np.testing.assert_array_equal(again.frame(2, scale=1.7), result.frame(2, scale=1.7))


def test_a_file_of_the_first_version_is_still_read(result, tmp_path):
    path = result.save(tmp_path / "networks.npz")
    with np.load(path) as stored:
        arrays = {name: stored[name] for name in stored}
    written = json.loads(str(arrays["provenance"]))
    method = written["settings"]["method"]
    del written["requested"]
    written["settings"] = {
        **{name: value for name, value in method.items() if name not in ("name", "samples")},
        **{name: value for name, value in written["settings"].items() if name != "method"},
        "observation": "frames",
    }
    written["sample_error"] = written.pop("held_out_rmse")
    written["canvas"]["frame0_from_image"] = written["canvas"].pop("reference_from_image")
    np.savez(path, **{**arrays, "provenance": np.array(json.dumps(written))})
    again = load(path)
    np.testing.assert_array_equal(again.image, result.image)
    assert again.settings == result.settings


def test_a_loaded_representation_can_be_continued(result, fit, tiny_burst, tmp_path):
    again = load(result.save(tmp_path / "scene.npz"), device="cpu")
    assert again.renderer.drawn == result.renderer.drawn > 0  # it goes on with fresh samples
    longer = fit(tiny_burst, initial=again, iterations=5, learning_rate=3e-3)
    assert len(longer.losses) == 65
    assert longer.losses[60:].mean() < result.losses[:5].mean()


def test_what_is_no_saved_reconstruction_is_refused(tmp_path):
    np.savez(tmp_path / "other.npz", frames=np.zeros(3))
    (tmp_path / "broken.npz").write_bytes(b"PK not a zip")
    for name in ("other.npz", "broken.npz", "missing.npz"):
        with pytest.raises(OutputError, match="is no saved reconstruction"):
            load(tmp_path / name)


def test_a_file_of_other_networks_is_refused(result, tmp_path):
    path = result.save(tmp_path / "scene.npz")
    with np.load(path) as stored:
        arrays = dict(stored)
    provenance = json.loads(str(arrays["provenance"]))
    damages = [{name: value for name, value in arrays.items() if name != "scene.network.0.weight"}]
    for change in ({"losses": None}, {"settings": "x"}, {"burst": {}}, {"ending": None}):
        damaged = {name: value for name, value in {**provenance, **change}.items() if value is not None}
        damages.append({**arrays, "provenance": np.array(json.dumps(damaged))})
    for number, damaged in enumerate(damages):
        np.savez(tmp_path / f"{number}.npz", **damaged)
        with pytest.raises(OutputError, match="that this version can read"):
            load(tmp_path / f"{number}.npz")


@pytest.fixture(scope="module")
def spline(tmp_path_factory):
    burst = simulate("cat", shape=(43, 51), frames=4, pitch=5.0, channels=1).burst
    return reconstruct(burst, device="cpu").save(tmp_path_factory.mktemp("spline") / "scene.npz")


def contents(path):
    with np.load(path) as stored:
        return dict(stored)


def refused_or_valid(path, good):
    """Whether a damaged result is refused as such; where it is not, its image must be one."""
    try:
        image = load(path, "cpu").image
    except FiberBurstError:
        return True
    assert image.shape == good.shape
    assert not np.isinf(image).any()
    assert not np.isnan(image).all()
    return False


def test_a_result_whose_bytes_are_damaged_is_refused_or_the_same(spline, tmp_path):
    good, whole, random = load(spline, "cpu").image, spline.read_bytes(), np.random.default_rng(5)
    damaged, refused = tmp_path / "scene.npz", 0
    for number, place in enumerate(random.integers(0, len(whole), 150)):
        other = bytes(random.integers(0, 256, 16, dtype=np.uint8))
        tail = (b"", bytes([whole[place] ^ 1 << number % 8]) + whole[place + 1 :], other + whole[place + 16 :])
        damaged.write_bytes(whole[:place] + tail[number % 3])
        is_refused = refused_or_valid(damaged, good)
        if not is_refused:
            np.testing.assert_array_equal(load(damaged, "cpu").image, good)
        refused += is_refused
    assert refused > 100


def test_a_result_whose_words_are_damaged_is_refused_or_has_an_image(spline, tmp_path):
    good, arrays, random = load(spline, "cpu").image, contents(spline), np.random.default_rng(7)
    text = str(arrays["provenance"])
    told = json.loads(text)
    signs = list('0123456789-e.,"x[]{}ntf')
    altered = [
        text[:place] + str(random.choice(signs)) + text[place + 1 :] for place in random.integers(0, len(text), 120)
    ]
    for name in told:
        altered += [json.dumps({**told, name: value}) for value in (None, [], "x", -1, 10**12, [[1]])]
    for shape in ([0, 0], [-1, 3], [10**5, 10**5], [3], "ab", [2.5, 3]):
        altered.append(json.dumps({**told, "canvas": {**told["canvas"], "shape": shape}}))
    altered += ['{"a":' * depth + "1" + "}" * depth for depth in (500, 5000)]
    for words in altered:
        np.savez(tmp_path / "scene.npz", **{**arrays, "provenance": np.array(words)})
        try:
            refused_or_valid(tmp_path / "scene.npz", good)
        except AssertionError:  # another size is one that the words can tell
            assert json.loads(words)["canvas"]["shape"] != list(good.shape)


def test_a_result_whose_arrays_are_damaged_is_refused_or_has_an_image(spline, tmp_path):
    good, arrays = load(spline, "cpu").image, contents(spline)
    for name in ("scene", "known", "nodes", "drawing", "homographies"):
        array = arrays[name]
        others = [np.array(3), array[:0], array[:1], array.astype(str), array.astype(np.float64)]
        if array.dtype.kind == "f":
            others += [np.full_like(array, value) for value in (np.nan, np.inf, 0)]
        for other in others:
            np.savez(tmp_path / "scene.npz", **{**arrays, name: other})
            refused_or_valid(tmp_path / "scene.npz", good)


@pytest.mark.parametrize(("name", "value"), [("scene", np.nan), ("drawing", np.inf)])
def test_a_result_that_shows_nothing_is_refused(spline, tmp_path, name, value):
    arrays = contents(spline)
    np.savez(tmp_path / "scene.npz", **{**arrays, name: np.full_like(arrays[name], value)})
    with pytest.raises(OutputError, match=r"its image is NaN or infinity.*make it again"):
        load(tmp_path / "scene.npz", "cpu")


def test_a_result_that_would_fill_the_memory_is_refused(spline, tmp_path):
    bomb = tmp_path / "bomb.npz"
    with zipfile.ZipFile(bomb, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("scene.npy", b"\0" * 4000)
    data = bomb.read_bytes()
    place = data.index(b"PK\x01\x02") + 24  # where the directory tells the size of the first member
    bomb.write_bytes(data[:place] + struct.pack("<I", 3 * 10**9) + data[place + 4 :])
    os.mkfifo(tmp_path / "pipe.npz")
    for name, said in (("bomb.npz", "claims 2,861 MiB"), ("pipe.npz", "is a pipe or a device")):
        with pytest.raises(OutputError, match=said):
            load(tmp_path / name, "cpu")
