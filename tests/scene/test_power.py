"""The spectrum of a scene from the cross spectrum of two noisy images of it, against the one that it was drawn from."""

import numpy as np
import pytest

from napari_fiberburst.scene.power import fit_power

FREQUENCY = (np.arange(1, 56) + 0.5) / 112
COUNT = 600 * FREQUENCY


def drawn(power, transfer, noise, seed):
    rng = np.random.default_rng(seed)
    seen = transfer * power
    return seen + rng.normal(size=len(power)) * np.sqrt((seen**2 + (seen + noise) ** 2) / (2 * COUNT))


@pytest.mark.parametrize("slope", [-2.0, -3.5])
def test_a_power_law_is_found_and_goes_on_where_nothing_is_passed(slope):
    power = FREQUENCY**slope
    transfer = np.clip(1.2 - 4 * FREQUENCY, 0, 1)  # nothing from 0.3 on
    noise = np.full_like(power, 1.0)

    ratios = [
        fit_power(FREQUENCY, drawn(power, transfer, noise, seed), noise, COUNT, transfer) / power for seed in range(8)
    ]

    seen = transfer * power > noise
    assert np.abs(np.log(np.median(ratios, axis=0)))[seen].max() < 0.2
    assert np.abs(np.log(np.median(ratios, axis=0))).max() < np.log(3)


def test_noise_is_not_taken_for_power():
    power = np.where(FREQUENCY < 0.15, FREQUENCY**-2.0, FREQUENCY**-2.0 * (0.15 / FREQUENCY) ** 8)
    noise = np.full_like(power, 40.0)

    found = [
        fit_power(FREQUENCY, drawn(power, np.ones_like(power), noise, seed), noise, COUNT, np.ones_like(power))
        for seed in range(8)
    ]

    band = (FREQUENCY > 0.25) & (FREQUENCY < 0.4)
    assert np.median(found, axis=0)[band].sum() < 0.1 * noise[band].sum()


def test_where_nothing_is_seen_there_is_still_an_answer():
    empty = np.zeros_like(FREQUENCY)
    assert np.isfinite(fit_power(FREQUENCY, empty, empty, COUNT, empty)).all()
