"""What a run takes grows with what it holds, and stays within what it may take."""

import numpy as np
import pytest
import torch

from napari_fiberburst import FiberBurstError, reconstruct
from napari_fiberburst.device import is_out_of_memory
from napari_fiberburst.memory import MemoryLimit, estimate_memory
from napari_fiberburst.networks.field import JointField
from napari_fiberburst.networks.scene import SceneField
from napari_fiberburst.scene import solve
from napari_fiberburst.settings import choose
from napari_fiberburst.settings.settings import bytes_of
from napari_fiberburst.simulation import simulate

SHAPE = (20, 256, 256, 3)
PAPER = {"preset": "paper", "iterations": 12, "batch": 1000, "motion": "homography"}
ENDINGS = [
    MemoryError(),
    torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 2.00 GiB"),
    RuntimeError("[enforce fail at alloc_cpu.cpp:124] err == 0. DefaultCPUAllocator: can't allocate memory"),
]


@pytest.fixture(scope="module")
def burst():
    return simulate("histology", shape=(45, 52), frames=5, pitch=4.0, seed=2).burst


@pytest.mark.parametrize(
    "more",
    [{"upsample": 2.0}, {"canvas": "union"}, {"encoding": "fourier"}, {"encoding": "fourier", "batch": 100_000}],
)
def test_more_to_hold_takes_more(more):
    assert estimate_memory(SHAPE, choose(**more)) > estimate_memory(SHAPE, choose())


def test_twice_the_frames_take_more_but_not_twice():
    usual, twice = (estimate_memory((frames, *SHAPE[1:]), choose()) for frames in (20, 40))
    assert usual < twice < 2 * usual


def test_a_published_run_is_told_by_its_batch():
    small, large = (estimate_memory(SHAPE, choose("paper", batch=batch)) for batch in (1000, 100_000))
    assert large - small > 99_000 * 4 * 256


def test_pixels_take_more_than_cores():
    cores, pixels = (
        estimate_memory(SHAPE, choose(), kind=kind, samples=samples)
        for kind, samples in (("cores", 3000), ("pixels", 40_000))
    )
    assert pixels > 1.2 * cores


@pytest.mark.parametrize(("text", "size"), [("4 GB", 4e9), ("1.5GiB", 1.5 * 2**30), (" 500 MB ", 5e8), (".5 TB", 5e11)])
def test_memory_is_told_with_its_unit(text, size):
    assert bytes_of(text) == size


@pytest.mark.parametrize("text", ["4", "GB", "-4 GB", "0 GB", "4 gigabytes", "nan GB", "4 GB 2", ""])
def test_memory_without_a_unit_is_refused(burst, text):
    with pytest.raises(FiberBurstError, match="memory must be a positive number with a unit, MB, GB"):
        reconstruct(burst, memory=text)


def test_a_network_sees_its_batches_in_as_many_parts_as_memory_asks_for():
    settings = choose("paper", batch=100_000)
    whole = estimate_memory(SHAPE, settings)
    assert MemoryLimit(SHAPE, choose(settings, memory=f"{whole / 1e6 + 1:.0f} MB")).parts() == 1
    assert MemoryLimit(SHAPE, choose(settings, memory=f"{0.8 * whole / 1e6:.0f} MB")).parts() == 2
    parts = MemoryLimit(SHAPE, choose(settings, memory="400 MB")).parts()
    assert estimate_memory(SHAPE, settings, parts=parts) <= 400e6 < estimate_memory(SHAPE, settings, parts=parts // 2)


@pytest.mark.parametrize("choices", [{}, {"preset": "paper"}, {"encoding": "fourier"}], ids=str)
def test_what_fits_in_no_number_of_parts_is_refused_and_told(burst, choices):
    with pytest.raises(FiberBurstError, match=r"takes about \d+ MB beside the burst, and memory allows 50 MB"):
        reconstruct(burst, **choices, memory="50 MB")


def test_one_value_a_core_is_taken_where_pixels_do_not_fit():
    burst = simulate("histology", shape=(127, 141), frames=8, pitch=6.0, channels=1, seed=3).burst
    assert reconstruct(burst, iterations=1).settings.flat()["observation"] == "pixels"
    cores = estimate_memory(burst.shape, choose(), kind="cores", samples=500)
    pixels = estimate_memory(burst.shape, choose(), kind="pixels", samples=9000)
    memory = f"{(cores + pixels) / 2e6:.1f} MB"
    result = reconstruct(burst, iterations=1, memory=memory)
    assert result.settings.flat()["observation"] == "cores"
    assert any("memory does not allow" in note for note in result.notes)
    with pytest.raises(FiberBurstError, match="memory allows"):
        reconstruct(burst, observation="pixels", iterations=1, memory=memory)


@pytest.mark.parametrize("error", ENDINGS, ids=lambda error: type(error).__name__)
def test_batches_are_halved_where_memory_runs_out_and_come_to_the_same(burst, monkeypatch, caplog, error):
    whole = reconstruct(burst, **PAPER)
    forward, most = JointField.forward, 300

    def cramped(field, points, frames):
        if len(points) > most:
            raise error
        return forward(field, points, frames)

    monkeypatch.setattr(JointField, "forward", cramped)
    parted = reconstruct(burst, **PAPER)
    assert [record.getMessage() for record in caplog.records if "in 4 parts" in record.getMessage()]
    # Rounding grows from step to step, as Adam divides by what the first gradients were.
    np.testing.assert_allclose(parted.losses[:5], whole.losses[:5], rtol=1e-3)
    assert (parted.ending, len(parted.losses)) == ("finished", len(whole.losses))


@pytest.mark.parametrize("encoding", ["fourier", "hash"])
def test_weighted_samples_in_parts_come_to_the_same_gradients(burst, encoding):
    choices = {"encoding": encoding, "iterations": 6, "batch": 500}
    whole = reconstruct(burst, **choices)
    parted = reconstruct(burst, **choices, memory="360 MB")
    np.testing.assert_allclose(parted.losses, whole.losses, rtol=2e-3)


def test_an_image_is_drawn_in_halves_where_memory_runs_out(burst, monkeypatch, caplog):
    result = reconstruct(burst, **PAPER)
    forward = SceneField.forward

    def cramped(scene, points):
        if len(points) > 600:
            raise MemoryError
        return forward(scene, points)

    monkeypatch.setattr(SceneField, "forward", cramped)
    np.testing.assert_allclose(result.render(), result.image, atol=1e-6)
    assert [record.getMessage() for record in caplog.records] == [
        f"memory ran out; {count} points are drawn at a time from now on" for count in (1170, 585)
    ]


def test_where_nothing_helps_it_is_told(burst, monkeypatch):
    def out_of_memory(*given, **more):
        raise MemoryError("Unable to allocate 7.45 GiB")

    monkeypatch.setattr(solve, "assemble", out_of_memory)
    with pytest.raises(
        FiberBurstError, match=r"memory ran out \(Unable to allocate 7.45 GiB\); such a run takes about"
    ):
        reconstruct(burst)


def test_other_errors_are_not_taken_for_it(burst, monkeypatch):
    assert not is_out_of_memory(RuntimeError("shapes do not match"))
    assert not is_out_of_memory(ValueError("can't allocate memory"))

    def wrong(*given, **more):
        raise RuntimeError("shapes do not match")

    monkeypatch.setattr(solve, "assemble", wrong)
    with pytest.raises(RuntimeError, match="shapes do not match"):
        reconstruct(burst)
