"""The networks have the published sizes, and start where they should."""

import pytest
import torch

from napari_fiberburst.networks.field import JointField
from napari_fiberburst.settings import NETWORK_MOTIONS, choose


def count(module):
    return sum(parameter.numel() for parameter in module.parameters())


def test_the_paper_preset_has_the_published_parameters():
    field = JointField(choose("paper").method, (20, 31, 37, 3))
    assert count(field.motion) == 134_152
    assert count(field.scene) == 329_987
    assert field.parameter_count == 464_139


@pytest.mark.parametrize(
    ("choices", "motion", "scene"),
    [
        # widths in and out of each layer, plus biases; 256 -> 256 is 65,792
        ({"encoding": "none"}, 134_152, (2 + 1) * 256 + 3 * 65_792 + 257 * 3),
        ({"encoding": "siren"}, 134_152, (2 + 1) * 256 + 3 * 65_792 + 257 * 3),
        ({"encoding": "nerf"}, 134_152, (2 + 2 * 2 * 16 + 1) * 256 + 3 * 65_792 + 257 * 3),
        ({"motion": "flow"}, (3 + 1) * 256 + 2 * 65_792 + 257 * 2, 329_987),
        ({"motion": "flow_tv"}, (3 + 1) * 256 + 2 * 65_792 + 257 * 2, 329_987),
        ({"motion": "none"}, 0, 329_987 + 256),
    ],
)
def test_other_choices_have_the_sizes_of_their_equations(choices, motion, scene):
    field = JointField(choose("paper", **choices).method, (20, 31, 37, 3))
    assert (count(field.motion), count(field.scene)) == (motion, scene)


@pytest.mark.parametrize("preset", ["auto", "paper"])
@pytest.mark.parametrize("motion", NETWORK_MOTIONS)
def test_every_motion_starts_at_the_identity(preset, motion):
    if motion not in choose(preset).motions or (preset, motion) == ("paper", "homography"):
        return
    field = JointField(choose(preset, motion=motion, encoding="fourier", sigma=5.0).method, (5, 31, 37, 1))
    points, frames = torch.rand(50, 2) * 2 - 1, torch.arange(50) % 5
    assert torch.equal(field.motion(points, frames)[:, :2], points)
    assert torch.equal(field.motion.scene_from_frame(), torch.eye(3).expand(5, 3, 3))


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_the_published_homographies_start_some_pixels_apart(seed):
    """As the authors start them: only the bias of the last layer is the identity, its weights are torch's own."""
    field = JointField(choose("paper").method, (20, 384, 384, 3), seed=seed)
    output = field.motion.network[-1]
    assert not output.bias.any()
    bound = 1 / output.in_features**0.5
    assert output.weight.abs().max() <= bound
    assert output.weight.std().item() == pytest.approx(bound / 3**0.5, rel=0.1)
    matrices = field.motion.scene_from_frame().detach()
    torch.testing.assert_close(matrices[:, 2, 2], torch.ones(20))
    apart = (matrices[-1, :2, 2] - matrices[0, :2, 2]).norm().item() * 384 / 2
    assert 1 < apart < 60


@pytest.mark.parametrize("encoding", ["fourier", "nerf", "none", "hash"])
def test_the_published_scene_starts_by_xavier_with_zero_biases(encoding):
    layers = [
        layer
        for layer in JointField(choose("paper", encoding=encoding).method, (5, 31, 37, 3)).scene.network
        if isinstance(layer, torch.nn.Linear)
    ]
    for layer in layers:
        assert not layer.bias.any()
        bound = (6 / (layer.in_features + layer.out_features)) ** 0.5
        assert layer.weight.abs().max() <= bound
        assert layer.weight.std().item() == pytest.approx(bound / 3**0.5, rel=0.1)


@pytest.mark.parametrize("motion", ["translation", "homography", "flow", "flow_tv"])
def test_a_registered_motion_starts_where_it_was_found(motion):
    start = torch.eye(3).repeat(4, 1, 1)
    start[:, 0, 2] = torch.tensor([0.0, 0.1, -0.2, 0.3])
    field = JointField(choose(motion=motion, encoding="fourier", sigma=5.0).method, (4, 31, 37, 1), start=start)
    points, frames = torch.rand(40, 2) * 2 - 1, torch.arange(40) % 4
    moved = points + torch.stack([start[frames, 0, 2], torch.zeros(40)], dim=1)
    torch.testing.assert_close(field.motion(points, frames), moved)
    torch.testing.assert_close(field.motion.scene_from_frame(), start)


@pytest.mark.parametrize("preset", ["auto", "paper"])
@pytest.mark.parametrize("motion", ["homography", "flow", "flow_tv"])
def test_the_start_at_the_identity_can_be_left(preset, motion):
    field = JointField(choose(preset, motion=motion, encoding="fourier", sigma=5.0).method, (5, 31, 37, 1))
    points, frames = torch.rand(50, 2) * 2 - 1, torch.arange(50) % 5
    field(points, frames).square().mean().backward()
    assert any(parameter.grad.abs().max() > 0 for parameter in field.motion.parameters())


def test_the_seed_decides_the_start():
    first, again, other = (
        JointField(choose("paper").method, (3, 31, 37, 1), seed=seed).state_dict() for seed in (1, 1, 2)
    )
    assert all(torch.equal(first[name], again[name]) for name in first)
    assert not torch.equal(first["scene.encoding.directions"], other["scene.encoding.directions"])
    assert not torch.equal(first["scene.network.0.weight"], other["scene.network.0.weight"])
