"""A known bundle is found again where the frames show it; another one is refused."""

import numpy as np
import pytest
import torch

from napari_fiberburst import Bundle, Burst, reconstruct
from napari_fiberburst.bundle.placement import find_bundle
from napari_fiberburst.errors import BundleError
from napari_fiberburst.quality import psnr
from napari_fiberburst.simulation import Camera, Scene, simulate

AWAY = {"shift": (2.2, -3.1), "degrees": -1.4}


def placement(probe):
    return find_bundle(probe.bundle, torch.from_numpy(probe.burst.frames).mean(dim=3), probe.burst)


def found_again(probe, shift, degrees, within=0.1):
    found = placement(probe)
    assert found.shift == pytest.approx(shift, abs=within)
    assert found.rotation == pytest.approx(degrees, abs=0.05)
    return found


@pytest.mark.parametrize("scene", ["histology", "usaf", "cat"])
@pytest.mark.parametrize(
    ("shift", "degrees"),
    [((0.4, -0.3), 0.0), ((3.5, 3.5), 0.0), ((0.0, 0.0), 0.5), ((-2.0, 3.0), -1.99), ((4.9, 0.0), 1.9)],
)
def test_a_bundle_that_has_moved_is_found_to_a_tenth_of_a_pixel(probe, scene, shift, degrees):
    found = found_again(probe(scene, shift=shift, degrees=degrees), shift, degrees)
    assert f"{np.hypot(*found.shift):.1f} px" in found.note
    assert f"{abs(found.rotation):.2f} degrees" in found.note


def test_a_bundle_that_has_not_moved_stays_as_it_is(probe):
    there = probe()
    found = placement(there)
    assert found.note == ""
    assert found.bundle is there.bundle


def test_a_bundle_calibrated_from_few_frames_is_found_in_them():
    """Its cores were taken as equally bright, because so few frames show gain and object alike."""
    burst = simulate("histology", shape=(63, 75), frames=6, pitch=4.0, seed=3).burst
    bundle = Bundle.from_burst(burst)
    assert bundle.brightness.std() < 0.1 * bundle.brightness.mean()
    assert find_bundle(bundle, torch.from_numpy(burst.frames).mean(dim=3), burst).bundle is bundle


@pytest.mark.parametrize("pitch", [3.0, 4.3, 8.0, 12.0])
def test_a_bundle_of_any_pitch_is_found_again(probe, pitch):
    found_again(probe(pitch=pitch, **AWAY), AWAY["shift"], AWAY["degrees"])


@pytest.mark.parametrize(
    "hard",
    [
        {"brightness": 0.03},
        {"camera": Camera(photons=200)},
        {"camera": Camera(photons=200), "brightness": 0.2},
        {"outline": "circle"},
        {"channels": 3},
        {"frames": 5},
        {"jitter": 0.0},
    ],
    ids=["dark", "200 electrons", "40 electrons", "circle", "colour", "5 frames", "perfect lattice"],
)
def test_a_bundle_is_found_again_in_hard_frames(probe, hard):
    found_again(probe(**hard, **AWAY), AWAY["shift"], AWAY["degrees"])


def test_a_bundle_is_found_again_where_most_of_the_object_is_black(probe):
    canvas = np.zeros((500, 500, 1), np.float32)
    canvas[:, 230:300] = 0.8
    found_again(probe(Scene(canvas, origin=(150.0, 150.0)), **AWAY), AWAY["shift"], AWAY["degrees"])


@pytest.mark.parametrize(
    ("moved", "figure"),
    [
        ({"shift": (4.0, 4.0)}, "moved by 5.[67] px"),
        ({"shift": (9.0, 0.0)}, "moved by 9.0 px"),
        ({"degrees": 2.3}, "and 2.3 degrees"),
        ({"zoom": 1.02}, "at 1.0[12][0-9] times the size"),
        ({"zoom": 0.98}, "at 0.98[0-9] times the size"),
        ({"zoom": 1.1}, "cores are 1.(09|1)[0-9]* times as far apart"),
        ({"zoom": 0.9}, "cores are 0.(89|9)[0-9]* times as far apart"),
    ],
    ids=str,
)
def test_a_bundle_that_has_moved_too_far_or_was_zoomed_is_refused_with_the_figure(probe, moved, figure):
    with pytest.raises(BundleError, match=figure) as refused:
        placement(probe(**moved))
    assert "calibrate" in str(refused.value)


@pytest.mark.parametrize("jitter", [0.0, 0.05, 0.1])
@pytest.mark.parametrize("another", [77, 78])
def test_another_bundle_of_the_same_pitch_is_refused(probe, jitter, another):
    with pytest.raises(BundleError, match=r"another bundle: \d+% of the cores.*correlates by -?0\.[01]"):
        placement(probe(another=another, jitter=jitter))


def test_frames_too_dark_to_show_cores_are_refused(probe):
    there = probe()
    black = Burst(np.random.default_rng(0).integers(0, 3, there.burst.shape, np.uint8), white_level=255)
    with pytest.raises(BundleError, match="another bundle"):
        find_bundle(there.bundle, torch.from_numpy(black.frames).mean(dim=3), black)


def test_another_size_is_refused_before_anything_is_computed(probe):
    there, other = probe(), probe(shape=(121, 153))
    with pytest.raises(BundleError, match=r"frames of 131 x 153 pixels, and the burst has 121 x 153; calibrate"):
        reconstruct(other.burst, bundle=there.bundle, device="cpu")


@pytest.mark.parametrize("frames", [1, 2])
def test_an_image_behind_a_moved_bundle_is_nearly_as_good(probe, frames):
    still = probe(frames=frames)
    moved = probe(frames=frames, **AWAY)
    choices = {"fill": True, "smoothness": 0.02, "device": "cpu"}
    first, second = (reconstruct(seen.burst, bundle=seen.bundle, **choices) for seen in (still, moved))
    best, got = (
        psnr(result.image / np.float32(255), seen.truth[0]) for result, seen in ((first, still), (second, moved))
    )
    assert got > best - 0.8
    assert not first.notes
    assert any("the bundle was found 3.8 px and 1.40 degrees away" in note for note in second.notes)
