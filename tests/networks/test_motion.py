"""Motion fields: what they map, how they turn back, what their prior counts."""

import numpy as np
import pytest
import torch

from napari_fiberburst.networks.motion import make_motion
from napari_fiberburst.settings import Flow, FlowTV, HomographyNetwork, NoMotion


def seeded():
    return torch.Generator().manual_seed(0)


def stirred(choice, frames=4, amount=0.02):
    """Return a motion field away from its start."""
    field = make_motion(choice, frames, (31, 37), seeded())
    torch.manual_seed(0)
    for parameter in field.network[-1].parameters():
        torch.nn.init.normal_(parameter, std=amount)
    return field


def test_still_adds_the_time():
    field = make_motion(NoMotion(), 3, (31, 37), seeded())
    mapped = field(torch.tensor([[0.1, 0.2], [0.3, 0.4]]), torch.tensor([0, 1]))
    np.testing.assert_allclose(mapped, [[0.1, 0.2, -1], [0.3, 0.4, 0]])
    assert field.scene_dimensions == 3


def test_homography_gradients_agree_with_finite_differences():
    field = stirred(HomographyNetwork(motion_width=5, motion_layers=1)).double()
    frames = torch.tensor([0, 1, 3])
    points = torch.rand(3, 2, dtype=torch.float64, generator=seeded()).requires_grad_()
    names = [name for name, _ in field.named_parameters()]

    def mapped(points, *values):
        return torch.func.functional_call(field, dict(zip(names, values, strict=True)), (points, frames))

    values = tuple(parameter.detach().clone().requires_grad_() for parameter in field.parameters())
    assert torch.autograd.gradcheck(mapped, (points, *values), eps=1e-6, atol=1e-6)


@pytest.mark.parametrize("choice", [HomographyNetwork(), Flow(flow_omega_0=5.0)])
def test_frame0_points_show_the_same_place_of_the_scene(choice):
    field = stirred(choice)
    points, frames = torch.rand(40, 2, generator=seeded()) * 2 - 1, torch.arange(40) % 4
    with torch.no_grad():
        first = field.frame0_points(points, frames)
        np.testing.assert_allclose(field(first, torch.zeros_like(frames)), field(points, frames), atol=2e-4)
        np.testing.assert_allclose(first[frames == 0], points[frames == 0], atol=2e-4)
    assert (first - points).abs().max() > 1e-3


def test_a_flow_that_folds_is_marked():
    field = stirred(Flow(), amount=0.5)  # waves of half a frame, thirty to a unit
    with torch.no_grad():
        first = field.frame0_points(torch.rand(200, 2, generator=seeded()), torch.ones(200, dtype=torch.long))
    assert first.isnan().any()


def test_total_variation_is_the_mean_absolute_jacobian():
    field = stirred(FlowTV(tv_weight=0.25, motion_width=8, flow_omega_0=3.0)).double()
    points, frames = torch.rand(5, 2, dtype=torch.float64, generator=seeded()), torch.tensor([0, 1, 2, 3, 1])
    places = torch.cat([points, field.times[frames, None]], dim=1)
    step, slopes = 1e-6, []
    with torch.no_grad():
        for axis in range(3):
            ahead, behind = places.clone(), places.clone()
            ahead[:, axis] += step
            behind[:, axis] -= step
            slopes.append((field.network(ahead) - field.network(behind)) / (2 * step))
    expected = 0.25 * torch.stack(slopes).abs().mean().item()
    assert field.roughness(points, frames).item() == pytest.approx(expected, rel=1e-5)


def test_only_flow_with_total_variation_has_a_prior():
    points, frames = torch.rand(5, 2), torch.zeros(5, dtype=torch.long)
    for choice in (NoMotion(), HomographyNetwork(), Flow(), FlowTV(tv_weight=0)):
        assert make_motion(choice, 2, (31, 37), seeded()).roughness(points, frames) is None
