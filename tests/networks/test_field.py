"""The networks have the published sizes, and start where they should."""

import pytest
import torch

from napari_fiberburst.networks.field import JointField
from napari_fiberburst.settings import MOTIONS, choose


def count(module):
    return sum(parameter.numel() for parameter in module.parameters())


def test_the_paper_preset_has_the_published_parameters():
    field = JointField(choose("paper"), frames=20, channels=3)
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
    field = JointField(choose("paper", **choices), frames=20, channels=3)
    assert (count(field.motion), count(field.scene)) == (motion, scene)


@pytest.mark.parametrize("preset", ["auto", "paper"])
@pytest.mark.parametrize("motion", MOTIONS)
def test_every_motion_starts_at_the_identity(preset, motion):
    if motion not in choose(preset).motions:
        return
    field = JointField(choose(preset, motion=motion, encoding="fourier"), frames=5, channels=1)
    points, frames = torch.rand(50, 2) * 2 - 1, torch.arange(50) % 5
    assert torch.equal(field.motion(points, frames)[:, :2], points)
    assert torch.equal(field.motion.scene_from_frame(), torch.eye(3).expand(5, 3, 3))


@pytest.mark.parametrize("motion", ["translation", "homography", "flow", "flow_tv"])
def test_a_registered_motion_starts_where_it_was_found(motion):
    start = torch.eye(3).repeat(4, 1, 1)
    start[:, 0, 2] = torch.tensor([0.0, 0.1, -0.2, 0.3])
    field = JointField(choose(motion=motion, encoding="fourier"), frames=4, channels=1, start=start)
    points, frames = torch.rand(40, 2) * 2 - 1, torch.arange(40) % 4
    moved = points + torch.stack([start[frames, 0, 2], torch.zeros(40)], dim=1)
    torch.testing.assert_close(field.motion(points, frames), moved)
    torch.testing.assert_close(field.motion.scene_from_frame(), start)


@pytest.mark.parametrize("preset", ["auto", "paper"])
@pytest.mark.parametrize("motion", ["homography", "flow", "flow_tv"])
def test_the_start_at_the_identity_can_be_left(preset, motion):
    field = JointField(choose(preset, motion=motion, encoding="fourier"), frames=5, channels=1)
    points, frames = torch.rand(50, 2) * 2 - 1, torch.arange(50) % 5
    field(points, frames).square().mean().backward()
    assert any(parameter.grad.abs().max() > 0 for parameter in field.motion.parameters())


def test_the_seed_decides_the_start():
    first, again, other = (JointField(choose("paper", seed=seed), 3, 1).state_dict() for seed in (1, 1, 2))
    assert all(torch.equal(first[name], again[name]) for name in first)
    assert not torch.equal(first["scene.encoding.directions"], other["scene.encoding.directions"])
    assert not torch.equal(first["scene.network.0.weight"], other["scene.network.0.weight"])
