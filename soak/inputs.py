"""Arrays and settings that nobody would think of: each ends in a result or in an error that says what to do."""

from typing import Any

import numpy as np
from hypothesis import HealthCheck, Phase, given, seed, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from napari_fiberburst import Burst, reconstruct
from napari_fiberburst.simulation import simulate
from soak.trials import Count, wrong_with, wrong_with_burst

TYPES = ("u1", "u2", "u4", "i2", "i8", "f2", "f4", "f8", "?", "c8", "<U3", ">u2", ">f4")
FILLS = ("burst", "burst", "noise", "even", "zero", "one frame", "steps", "huge", "tiny", "negative")
BLEMISHES = ("none", "none", "nan", "inf", "nan frame", "black frame", "saturated", "all nan")
LAYOUTS = ("C", "Fortran", "reversed", "every other", "read-only")


def arrays(count: Count, examples: int) -> None:
    """Reconstruct arrays of any shape, type, order in memory and content."""

    @_drawn(examples)
    @given(
        shape=st.one_of(
            st.tuples(st.integers(2, 6), st.integers(24, 52), st.integers(24, 52)),
            st.tuples(st.integers(2, 6), st.integers(24, 44), st.integers(24, 44), st.integers(1, 4)),
            st.tuples(st.integers(1, 6), st.integers(1, 44), st.integers(1, 44)),
            st.lists(st.integers(0, 9), min_size=0, max_size=6).map(tuple),
        ),
        kind=st.sampled_from(TYPES),
        fill=st.sampled_from(FILLS),
        blemish=st.sampled_from(BLEMISHES),
        layout=st.sampled_from(LAYOUTS),
        number=st.integers(0, 2**31),
    )
    def one(shape: tuple[int, ...], kind: str, fill: str, blemish: str, layout: str, number: int) -> None:
        frames = _laid(_array(shape, kind, fill, blemish, number), layout)
        words = f"shape {shape}, {kind}, {fill}, {blemish}, {layout}, number {number}"
        count.check(lambda: reconstruct(frames, device="cpu"), wrong_with, words)

    one()


def choices(count: Count, examples: int) -> None:
    """Reconstruct a small burst by settings that may be anything."""
    burst = simulate("histology", shape=(37, 41), frames=4, pitch=4.0, channels=1, seed=3).burst
    anything = st.one_of(st.none(), st.integers(-3, 10**9), st.floats(), st.text(max_size=5), st.booleans())
    known = {
        "motion": st.sampled_from(
            ["translation", "similarity", "affine", "homography", "deformable", "auto", "none", "flow", "flow_tv"]
        ),
        "encoding": st.sampled_from(["spline", "none", "nerf", "fourier", "hash", "siren"]),
        "iterations": st.integers(-1, 4),
        "sigma": st.floats(-1, 30),
        "canvas": st.sampled_from(["reference", "union", "somewhere"]),
        "upsample": st.integers(-1, 5),
        "smoothness": st.floats(-1, 10),
        "black_level": st.floats(-10, 300),
        "white_level": st.floats(-10, 300),
        "flatten": st.sampled_from([True, False, "auto"]),
        "seed": st.integers(-2, 2**40),
        "device": st.sampled_from(["cpu", "cuda:7", "auto", "abacus"]),
        "time_budget": st.floats(-1, 2),
    }
    mixed = {name: st.one_of(values, values, values, anything) for name, values in known.items()}
    some = st.lists(st.sampled_from(sorted(mixed)), min_size=1, max_size=3, unique=True)

    @_drawn(examples)
    @given(
        preset=st.sampled_from(["auto", "auto", "auto", "paper", "paper", "papier"]),
        more=some.flatmap(lambda names: st.fixed_dictionaries({name: mixed[name] for name in names})),
        other=st.one_of(st.just({}), st.dictionaries(st.text("abc", min_size=1, max_size=3), anything, max_size=1)),
    )
    def one(preset: str, more: dict[str, Any], other: dict[str, Any]) -> None:
        # A network takes as long as it is asked to; what is tried is whether it runs at all.
        bounded = {"iterations": 2, **more, **other}
        if not isinstance(bounded["iterations"], int) or bounded["iterations"] > 4:
            bounded["time_budget"] = 2.0
        words = f"preset {preset}, {bounded}"
        count.check(lambda: reconstruct(burst, preset=preset, **bounded), wrong_with, words)

    one()


def _drawn(examples: int) -> Any:
    """Return how hypothesis draws: the same inputs each time; all are tried, none is made smaller."""
    drawn = settings(
        max_examples=examples,
        deadline=None,
        database=None,
        phases=(Phase.explicit, Phase.generate),
        suppress_health_check=list(HealthCheck),
    )
    return lambda test: seed(1)(drawn(test))


def _array(shape: tuple[int, ...], kind: str, fill: str, blemish: str, number: int) -> NDArray[Any]:
    random = np.random.default_rng(number)
    made = _filled(shape, fill, random)
    if made.ndim >= 3 and made.size:
        if blemish == "black frame":
            made[0] = 0
        elif blemish == "saturated":
            made[made > np.quantile(made, 0.6)] = made.max()
        elif np.dtype(kind).kind in "fc":
            made = made.astype(np.float64)
            if blemish == "all nan":
                made[:] = np.nan
            elif blemish == "nan frame":
                made[-1] = np.nan
            elif blemish in ("nan", "inf"):
                made[random.random(made.shape) < 0.02] = np.nan if blemish == "nan" else np.inf
    with np.errstate(all="ignore"):
        return made.astype(kind)


def _filled(shape: tuple[int, ...], fill: str, random: np.random.Generator) -> NDArray[np.float64]:
    if fill == "zero":
        return np.zeros(shape)
    if fill == "even":
        return np.full(shape, 77.0)
    if fill in ("burst", "one frame") and len(shape) >= 3 and min(shape[:3]) > 0 and min(shape[1:3]) >= 24:
        simulated = simulate(
            "cat", shape=(shape[1], shape[2]), frames=shape[0], pitch=4.0, channels=1, seed=1
        ).burst.frames
        frames = np.repeat(simulated[:1], shape[0], axis=0) if fill == "one frame" else simulated
        return 255.0 * np.broadcast_to(frames.reshape(*shape[:3], *(1,) * (len(shape) - 3)).astype(np.float64), shape)
    noise: NDArray[np.float64] = random.random(shape)
    scales = {"huge": 1e30, "tiny": 1e-30, "negative": -200.0}
    if fill == "steps":
        steps: NDArray[np.float64] = np.floor(3 * noise) * 100
        return steps
    noise *= scales.get(fill, 255.0)
    return noise


def _laid(array: NDArray[Any], layout: str) -> NDArray[Any]:
    if layout == "Fortran":
        return np.asfortranarray(array)
    if layout == "reversed":
        return array[::-1] if array.ndim else array
    if layout == "every other" and array.ndim:
        return np.repeat(array, 2, axis=-1)[..., ::2]
    if layout == "read-only":
        array = np.array(array)
        array.flags.writeable = False
    return array


def bursts(count: Count, examples: int) -> None:
    """Make a `Burst` of frames with axes, levels and times that may be anything."""
    frames = np.random.default_rng(2).integers(0, 255, (3, 29, 31), np.uint8)
    number = st.one_of(st.none(), st.none(), st.integers(-50, 300), st.floats(-1e3, 1e3), st.floats())

    @_drawn(examples)
    @given(
        axes=st.one_of(st.none(), st.just("TYX"), st.text("TYXCZ", max_size=5)),
        black=number,
        white=number,
        times=st.one_of(st.none(), st.just([0.0, 0.5, 1.0]), st.lists(st.floats(), max_size=4)),
        size=st.one_of(st.none(), st.just(0.5), st.floats(), st.tuples(st.floats(), st.floats())),
        shape=st.sampled_from([(3, 29, 31), (3, 29, 31), (29, 31), (3, 29, 31, 1), (1, 3, 29, 31), (0, 29, 31)]),
    )
    def one(axes: str | None, black: Any, white: Any, times: Any, size: Any, shape: tuple[int, ...]) -> None:
        array = np.resize(frames, shape)
        more = {"axes": axes, "black_level": black, "white_level": white, "times": times, "pixel_size": size}
        given_here = {name: value for name, value in more.items() if value is not None}
        count.check(lambda: Burst(array, **given_here), wrong_with_burst, f"shape {shape}, {given_here}")

    one()
