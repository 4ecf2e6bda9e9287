"""Every operator and its adjoint agree, <A x, y> = <x, A' y>, on odd and unequal sides."""

import inspect
import pkgutil
from importlib import import_module

import pytest
import torch

from napari_fiberburst import operators
from napari_fiberburst.motion.displacement import ControlGrid
from napari_fiberburst.operators.footprint import Footprint
from napari_fiberburst.operators.grid import Grid, PathSampling, Sampling
from napari_fiberburst.operators.jacobian import ControlSlopes, GainSlopes, GeneratorSlopes, JointJacobian
from napari_fiberburst.operators.priors import MEMBRANE, THIN_PLATE, SmoothnessPrior
from napari_fiberburst.operators.stencil import Stencil

GRID = Grid(x0=-3.0, y0=2.0, spacing=1.3, shape=(31, 37))
FRAMES, SAMPLES, CORES = 3, 53, 19


GENERATOR = torch.Generator().manual_seed(0)


def random(*shape):
    return torch.randn(*shape, dtype=torch.float64, generator=GENERATOR)


def points(*shape):
    """Return points on the grid, between its nodes and beyond it; one is nowhere."""
    scattered = torch.rand(*shape, 2, dtype=torch.float64, generator=GENERATOR) * 60 - 10
    scattered.view(-1, 2)[0] = torch.nan
    return scattered


def jacobian(motion, footprint):
    """Return the Jacobian of samples in three frames."""
    return JointJacobian(
        sampling=GRID.at(points(FRAMES, SAMPLES)),
        footprint=footprint,
        factors=random(FRAMES, SAMPLES),
        values=random(FRAMES, SAMPLES),
        motion=motion,
    )


def operators_to_test():
    """Yield name, operator, something it takes, and something it gives."""
    footprint = Footprint(GRID, 2.7, torch.device("cpu"))
    scene, samples = random(*GRID.shape), random(FRAMES, SAMPLES)
    yield "sampling", GRID.at(points(FRAMES, SAMPLES)), scene, samples
    yield "sampling of no points", GRID.at(points(1)[:0]), scene, random(0)
    yield "sampling along paths", GRID.along(points(FRAMES, SAMPLES, 5)), scene, samples
    yield "footprint", footprint, scene, random(*GRID.shape)
    yield "footprint smaller than a pixel", Footprint(GRID, 0.2, torch.device("cpu")), scene, random(*GRID.shape)
    yield "membrane", MEMBRANE, scene, random(*GRID.shape)
    yield "thin plate", THIN_PLATE, scene, random(*GRID.shape)
    yield "stencil", GRID.at(points(SAMPLES)).normal(random(SAMPLES)), scene, random(*GRID.shape)
    for dof in (2, 4, 6, 8):
        for through in (None, footprint):
            blocks = (scene, random(FRAMES, dof), random(FRAMES))
            name = f"joint jacobian of {dof} generators, {'points' if through is None else 'footprints'}"
            yield name, jacobian(GeneratorSlopes(random(FRAMES, dof, SAMPLES)), through), blocks, samples
    # Some samples share a core, and one core has none.
    gains = GainSlopes(random(FRAMES, SAMPLES), torch.arange(SAMPLES) % (CORES - 1), CORES)
    yield "slopes along gains", gains, random(CORES), samples
    controls = ControlGrid(8.0, (7, 9))
    weights = controls.at(points(SAMPLES).nan_to_num(3.0))
    yield "control points", weights, random(FRAMES, 2, 63), random(FRAMES, 2, SAMPLES)
    yield "slopes along generators", GeneratorSlopes(random(FRAMES, 8, SAMPLES)), random(FRAMES, 8), samples
    bending = ControlSlopes(random(FRAMES, SAMPLES), random(FRAMES, SAMPLES), weights)
    blocks = (scene, random(FRAMES, 2, 63), random(FRAMES))
    yield "slopes along control points", bending, random(FRAMES, 2, 63), samples
    yield "joint jacobian of control points", jacobian(bending, footprint), blocks, samples


def inner(first, second):
    first, second = ((part,) if isinstance(part, torch.Tensor) else part for part in (first, second))
    return sum(float((a * b).sum()) for a, b in zip(first, second, strict=True))


@pytest.mark.parametrize(
    ("operator", "taken", "given"), [pytest.param(*case[1:], id=case[0]) for case in operators_to_test()]
)
def test_an_operator_and_its_adjoint_agree(operator, taken, given):
    there, back = inner(operator(taken), given), inner(taken, operator.adjoint(given))
    assert there == pytest.approx(back, rel=1e-6, abs=1e-9)
    assert given.numel() == 0 or there != 0


OPERATORS = {
    Sampling,
    PathSampling,
    Footprint,
    SmoothnessPrior,
    Stencil,
    JointJacobian,
    GeneratorSlopes,
    ControlSlopes,
    GainSlopes,
}


def test_every_operator_is_in_the_list():
    defined = {
        kind
        for found in pkgutil.iter_modules(operators.__path__)
        for _, kind in inspect.getmembers(import_module(f"{operators.__name__}.{found.name}"), inspect.isclass)
        if hasattr(kind, "adjoint") and kind.__module__.startswith(operators.__name__)
        if not getattr(kind, "_is_protocol", False)
    }
    assert defined == OPERATORS
    assert defined <= {type(operator) for _, operator, _, _ in operators_to_test()}
