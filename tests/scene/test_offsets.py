"""Light that cores show by themselves is told from the object where it moves, and is not seen where there is none."""

from dataclasses import replace

import numpy as np
import pytest

from napari_fiberburst import Bundle, Registration, reconstruct
from napari_fiberburst.bundle.samples import sample
from napari_fiberburst.scene.offsets import find_offsets

SHAPE = (137, 151)


@pytest.fixture(scope="module")
def glowing(recorded):
    simulated = recorded(frames=12, seed=1, offset=0.4)
    return simulated, reconstruct(simulated.burst)


def test_offsets_are_found_and_taken_out(glowing, quality, monkeypatch):
    simulated, result = glowing
    x, y = result.bundle.centres.round().astype(int).T
    inside = (x > 12) & (x < SHAPE[1] - 12) & (y > 12) & (y < SHAPE[0] - 12)
    truth = simulated.background[y[inside], x[inside], 0]
    shown = result.bundle.offsets[inside, 0] * result.bundle.transmission[y[inside], x[inside]]
    assert np.corrcoef(shown, truth)[0, 1] > 0.7
    slope = np.polyfit(truth, shown / simulated.burst.white_level, 1)[0]
    assert 0.2 < slope < 1.1  # the scene follows the rest
    monkeypatch.setattr("napari_fiberburst.pipeline.stages.find_offsets", lambda *_: None)
    assert quality(result, simulated) > quality(reconstruct(simulated.burst), simulated) + 0.2


def test_a_kept_bundle_takes_its_offsets_to_another_burst(glowing, tmp_path):
    simulated, result = glowing
    kept = Bundle.load(result.bundle.save(tmp_path / "probe.bundle"))
    np.testing.assert_array_equal(kept.offsets, result.bundle.offsets)
    burst = simulated.burst
    without = replace(kept, offsets=0 * kept.offsets)
    taken = sample(burst, without, device="cpu").values - sample(burst, kept, device="cpu").values
    span = burst.white_level - burst.black_level
    seen = (taken[0, :, 0] != 0).numpy()
    np.testing.assert_allclose(taken[0, seen, 0], (kept.offsets / kept.gains)[seen, 0] / span, atol=1e-5)


def test_a_bundle_without_offsets_gets_none(recorded):
    assert not reconstruct(recorded(frames=12, seed=1).burst).bundle.offsets.any()


@pytest.mark.parametrize(("frames", "still"), [(12, True), (5, False)])
def test_nothing_is_told_by_an_object_at_rest_or_by_few_frames(glowing, frames, still):
    simulated, result = glowing
    few = simulated.take(range(frames))
    samples = sample(few.burst, replace(result.bundle, offsets=0 * result.bundle.offsets), device="cpu")
    known = replace(Registration.known(few.homographies, SHAPE, samples.cores), unexplained=0.1)
    assert find_offsets(samples, replace(known, is_still=still)) is None
    if still:
        assert find_offsets(samples, known) is not None
