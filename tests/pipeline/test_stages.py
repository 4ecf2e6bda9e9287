"""The steps of the method can be called one by one, each fed from a file, and come to what `reconstruct` comes to."""

from dataclasses import FrozenInstanceError, fields, is_dataclass

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree

from napari_fiberburst import (
    Bundle,
    Burst,
    Registration,
    Samples,
    Scene,
    calibrate,
    diagnose,
    flatten,
    reconstruct,
    refine,
    register,
    remeasure,
    render,
    sample,
    solve,
)
from napari_fiberburst.errors import FiberBurstError
from napari_fiberburst.quality import motion_error, psnr

SHAPE = (127, 141)


@pytest.fixture(scope="module")
def stages(cores):
    """Return what the steps come to: bundle, samples, registration, scene."""
    bundle = calibrate(cores.burst)
    registration = register(sample(cores.burst, bundle))
    bundle, registration = remeasure(cores.burst, bundle, registration)
    samples = sample(cores.burst, bundle)
    registration = refine(samples, registration)
    bundle, registration = flatten(cores.burst, bundle, registration)
    samples = sample(cores.burst, bundle)
    return bundle, samples, registration, solve(samples, registration)


def same(first, second):
    """Whether two values of the method have the same contents."""
    if is_dataclass(first):
        return all(same(getattr(first, item.name), getattr(second, item.name)) for item in fields(first))
    if isinstance(first, torch.Tensor):
        return torch.equal(first, second)
    if isinstance(first, np.ndarray):
        return np.array_equal(first, second, equal_nan=first.dtype.kind == "f")
    return first == second


def test_the_steps_come_to_what_reconstruct_comes_to(cores, fitted, stages):
    bundle, _, registration, scene = stages
    image = render(cores.burst, bundle, registration, scene, fill=True)
    assert image.shape == fitted.image.shape
    assert psnr(image, cores.truth[0]) == pytest.approx(psnr(fitted.image, cores.truth[0]), abs=0.1)
    assert motion_error(registration.reference_from_frame, fitted.homographies, SHAPE) < 0.02
    found = diagnose(cores.burst, bundle, registration, scene)
    # The object travels little, so reconstruct has kept a second start, from equal gains: frames lie some hundredths of
    # a pixel apart, and coverage is steep at the edges of footprints.
    assert np.quantile(np.abs(found.coverage - fitted.coverage), 0.999) < 0.25
    assert found.resolution == pytest.approx(fitted.resolution, rel=0.05)
    np.testing.assert_allclose(found.bundle.brightness, fitted.bundle.brightness, rtol=0.02, atol=0.02)


def test_each_step_can_be_fed_from_a_file(cores, stages, tmp_path):
    kept = {
        kind: kind.load(value.save(tmp_path / f"{kind.__name__}{kind._ending}"))
        for kind, value in zip((Bundle, Samples, Registration, Scene), stages, strict=True)
    }
    for value in stages:
        assert same(value, kept[type(value)])
    scene = solve(kept[Samples], kept[Registration])
    assert torch.equal(scene.coefficients, stages[3].coefficients)
    image = render(cores.burst, kept[Bundle], kept[Registration], kept[Scene])
    np.testing.assert_array_equal(image, render(cores.burst, stages[0], stages[2], stages[3]))


@pytest.mark.parametrize("kind", [Samples, Registration, Scene])
def test_a_file_of_another_step_is_refused(stages, tmp_path, kind):
    value = next(value for value in stages if not isinstance(value, kind) and not isinstance(value, Bundle))
    path = value.save(tmp_path / "value.safetensors")
    with pytest.raises(FiberBurstError, match=r"value\.safetensors is of format .* expected"):
        kind.load(path)


def test_values_of_the_method_are_frozen(stages):
    for value in stages:
        with pytest.raises(FrozenInstanceError):
            setattr(value, fields(value)[0].name, None)


def test_gains_are_taken_out_of_samples(stages, cores):
    bundle, samples, registration, _ = stages
    corrected = registration.correct(samples)
    truth = np.array(cores.bundle.gains)
    distance, match = cKDTree(cores.bundle.centres).query(bundle.centres)
    near = distance < 1.5
    known = bundle.brightness[near] * registration.gains[near] / truth[match[near]]
    assert known.std() / known.mean() < 0.08
    assert float((corrected.weights > 0).float().mean()) > 0.95


def test_a_burst_that_stands_still_goes_through_the_steps(cores):
    still = Burst(np.repeat(cores.burst.frames[:1], 3, axis=0))
    bundle = calibrate(still)
    samples = sample(still, bundle)
    registration = register(samples)
    assert registration.is_still
    assert refine(samples, registration) is registration
    assert remeasure(still, bundle, registration) == (bundle, registration)
    assert flatten(still, bundle, registration) == (bundle, registration)
    image = render(still, bundle, registration, solve(samples, registration))
    assert np.isfinite(image).mean() > 0.9


def test_a_result_says_what_its_bundle_is(cores, fitted):
    again = reconstruct(cores.burst, bundle=fitted.bundle, fill=True)
    assert psnr(again.image, cores.truth[0]) > psnr(fitted.image, cores.truth[0]) - 0.5
