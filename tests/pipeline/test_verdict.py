"""Verdicts hold in both directions: what a fault has spoilt is not good, and what no fault has touched is."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from napari_fiberburst import Burst, reconstruct
from napari_fiberburst.motion.registration import Registration
from napari_fiberburst.pipeline.goodness import GoodnessOfFit
from napari_fiberburst.pipeline.verdict import judge
from napari_fiberburst.simulation import Camera, Faults, simulate

SHAPE = (131, 149)


def recorded(scene="tissue", *, frames=14, pitch=4.7, photons=8000, seed=1, **faults):
    return simulate(
        scene,
        shape=SHAPE,
        frames=frames,
        channels=1,
        physics="core",
        pitch=pitch,
        seed=seed,
        camera=Camera(photons=photons),
        faults=Faults(**faults),
    )


def says(result, words):
    return any(words in note for note in result.notes)


@pytest.mark.parametrize(
    "burst", [{"scene": "usaf"}, {"frames": 6}, {"pitch": 7.0}, {"photons": 500}, {"scene": "cat", "seed": 3}], ids=str
)
def test_a_burst_without_a_fault_is_good(burst):
    result = reconstruct(recorded(**burst).burst)
    assert result.quality == "good", result.notes


@pytest.mark.parametrize("fault", [{"flicker": 0.1}, {"vignette": 3.0}, {"deformation": 2.0}], ids=str)
def test_a_fault_that_the_model_follows_leaves_an_image_good(fault):
    result = reconstruct(recorded(frames=20, **fault).burst)
    assert result.quality == "good", result.notes


def test_an_object_that_moves_during_exposure_is_doubtful():
    assert reconstruct(recorded(frames=20, smear=1.0).burst).quality == "doubtful"


def test_an_object_that_bends_between_neighbouring_cores_is_not_good():
    result = reconstruct(recorded(deformation=4.0, deformation_length=20.0).burst)
    assert result.quality in ("doubtful", "bad")
    assert says(result, "of what changes in them")


def test_a_pattern_that_is_not_found_is_seen_standing_still():
    result = reconstruct(Burst(plain(recorded(frames=12), gains_at_random()), axes="TYX"))
    assert result.bundle.pattern == "none"
    assert result.quality in ("doubtful", "bad")
    assert says(result, "stands still")


def gains_at_random():
    """Return a pattern without a pitch."""
    return 1 + 0.15 * np.random.default_rng(0).standard_normal(SHAPE)


def plain(simulated, gains):
    """Return the object as a camera without a bundle sees it, with the gains of its pixels."""
    noise = np.random.default_rng(1).normal(0, 2, (len(simulated.truth), *SHAPE))
    return np.clip(200 * simulated.truth[..., 0] * gains + noise, 0, 255).astype(np.uint8)


@pytest.mark.parametrize("scene", ["histology", "tissue"])
def test_frames_without_any_bundle_can_be_good(scene):
    simulated = recorded(scene, frames=8, field=0.9)
    result = reconstruct(Burst(plain(simulated, simulated.shading[..., 0]), axes="TYX"))
    assert result.bundle.pattern == "none"
    assert result.quality == "good", result.notes


def test_noise_alone_is_no_reason_for_doubt():
    faint = recorded("retina", photons=200, frames=12)
    result = reconstruct(faint.burst)
    assert result.misfit < 1.1
    assert not says(result, "of what changes in them")


FIT = GoodnessOfFit(
    error=0.08,
    disagreement=0.06,
    misfit=2.0,
    frame_misfit=(2.0,) * 16,
    core_misfit=np.full(300, 2.0, np.float32),
    structure=0.04,
    still=0.7,
    smear=0.0,
    falloff=1.1,
    is_noise_known=True,
)


def verdict(frames=16, used=None, confidence=None, **change):
    registration = replace(Registration.known(np.tile(np.eye(3), (frames, 1, 1)), SHAPE, 300), travel=9.0)
    if used is not None:
        registration = replace(registration, used=used, confidence=confidence)
    return judge(replace(FIT, **change), registration, 4.7, gains_known=False)


def test_each_sign_of_a_fault_is_a_reason_of_its_own():
    assert verdict().quality == "good"
    spoilt = np.full(300, 2.0, np.float32)
    spoilt[:9] = 30.0
    uneven = (1.0,) * 8 + (3.0,) * 8
    signs = [
        {"error": 0.3, "disagreement": 0.2},
        {"disagreement": 0.4},
        {"still": 5.0},
        {"structure": 0.4, "error": 0.15, "disagreement": 0.2},
        {"structure": -0.1},
        {"smear": 4.0, "structure": -0.1},
        {"falloff": 2.0},
        {"frame_misfit": uneven, "error": 0.15, "disagreement": 0.2},
        {"core_misfit": spoilt, "error": 0.15, "disagreement": 0.2},
    ]
    reasons = [verdict(**sign).reasons for sign in signs]
    assert all(len(found) == 1 for found in reasons)
    assert len(set(reasons)) == len(signs)


def test_a_still_pattern_that_only_many_frames_can_show_is_no_reason():
    assert verdict(frames=300, still=5.0).quality == "good"
    assert verdict(frames=300, still=40.0).quality == "doubtful"


def test_few_frames_may_miss_more_of_what_is_left_out():
    apart = {"disagreement": 0.2}
    assert verdict(frames=6, error=0.3, **apart).quality == "good"
    assert verdict(frames=16, error=0.3, **apart).quality == "doubtful"
    assert verdict(frames=16, error=0.8, **apart).quality == "bad"


def test_frames_that_differ_from_the_rest_cast_doubt_on_it_and_blank_ones_do_not():
    used, agreement = np.ones(16, bool), np.ones(16)
    used[:5], agreement[:5] = False, 0.1
    assert verdict(used=used, confidence=agreement).reasons == (
        "only 11 of the 16 frames that show anything could be registered",
    )
    agreement[:5] = np.nan
    assert verdict(used=used, confidence=agreement).quality == "good"


def test_single_cores_that_are_missed_do_not_spoil_an_image_whose_halves_agree():
    single = np.full(300, 2.0, np.float32)
    single[:9] = 20.0
    assert verdict(error=0.3, disagreement=0.08, core_misfit=single).quality == "good"
    assert verdict(error=0.3, disagreement=0.2, core_misfit=single).quality == "doubtful"


@pytest.mark.parametrize("known", [{"misfit": 8.0}, {"structure": 0.3}], ids=str)
def test_what_many_cores_have_in_common_is_not_of_single_cores(known):
    single = np.full(300, 2.0, np.float32)
    single[:9] = 20.0
    assert verdict(error=0.3, disagreement=0.08, core_misfit=single, **known).quality == "doubtful"
    assert verdict(error=0.3, disagreement=0.08).quality == "doubtful"


def test_misfits_are_known_per_frame_and_per_core(monkeypatch):
    from napari_fiberburst.pipeline import diagnose

    kept = []

    def keep(*arguments):
        kept.append(collect(*arguments))
        return kept[-1]

    collect = diagnose.collect
    monkeypatch.setattr(diagnose, "collect", keep)
    simulated = recorded(frames=10)
    frames = simulated.burst.frames[..., 0].copy() * 255
    result = reconstruct(Burst(frames.round().astype(np.uint8), axes="TYX"))
    (fit,) = kept
    assert len(fit.frame_misfit) == 10
    assert fit.core_misfit.shape == (len(result.bundle.centres),)
    assert np.nanmean(np.square(fit.core_misfit)) == pytest.approx(fit.misfit**2, rel=0.15)
    assert torch.isfinite(torch.tensor(fit.disagreement))
