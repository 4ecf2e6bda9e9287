"""Settings: what a user may say, and what comes of it."""

import json
from fractions import Fraction

import numpy as np
import pytest

from napari_fiberburst.errors import SettingsError
from napari_fiberburst.settings import (
    ENCODING_NAMES,
    ENCODINGS,
    METHODS,
    MOTIONS,
    PUBLISHED_MOTIONS,
    FlowTV,
    Fourier,
    Hash,
    Homography,
    HomographyNetwork,
    NeRF,
    NetworkMethod,
    PublishedMethod,
    Settings,
    choose,
)
from napari_fiberburst.settings.parameter import knobs_of


def test_the_paper_preset_has_the_published_values():
    settings = choose("paper").method
    assert isinstance(settings, PublishedMethod)
    assert settings.motion == HomographyNetwork(motion_layers=3, motion_width=256)
    assert settings.encoding == Fourier(features=256, sigma=5.0)
    assert (settings.scene_layers, settings.scene_width) == (4, 256)
    assert (settings.iterations, settings.learning_rate) == (3000, 1e-4)
    assert ENCODINGS["nerf"]() == NeRF(highest_octave=15)
    assert ENCODINGS["hash"]() == Hash(levels=12, level_features=2, table_bits=16, base_resolution=4, growth=1.61)
    assert ENCODINGS["siren"]().omega_0 == 30
    assert MOTIONS["flow_tv"]().tv_weight == 1


def test_fields_reach_the_part_they_belong_to():
    settings = choose("paper", motion="flow_tv", tv_weight=0.5, features=8, iterations=7)
    assert settings.method.motion == FlowTV(tv_weight=0.5)
    assert settings.method.encoding == Fourier(features=8, sigma=5.0)
    assert settings.method.iterations == 7


def test_none_leaves_the_value_that_is_there():
    assert choose(sigma=None, motion=None, iterations=None) == choose()
    start = choose("paper", sigma=2.0, iterations=9)
    assert choose(start, sigma=None) == start


def test_a_settings_object_stands_for_a_name():
    assert choose(encoding=NeRF(highest_octave=4)) == choose(encoding="nerf", highest_octave=4)


@pytest.mark.parametrize(
    ("choices", "said"),
    [
        ({"preset": "papre"}, "known: auto, paper"),
        ({"motion": "zoom"}, "known: none, translation, similarity, affine, homography, flow, flow_tv"),
        ({"encoding": "fuorier"}, "known: spline, none, nerf, fourier, hash, siren"),
        ({"encoding": Homography()}, "known: spline, none, nerf"),
        (
            {"preset": "paper", "sgima": 3},
            "is no setting; known with motion 'homography' with encoding 'fourier': .*sigma",
        ),
        ({"encoding": "nerf", "sigma": 3.0}, "belongs to encoding 'fourier' and does not apply"),
        ({"tv_weight": 3.0}, "belongs to motion 'flow_tv'"),
        ({"preset": "paper", "sigma": 0}, r"sigma must be a number above 0 and of at most 1e\+06, or None; got 0"),
        ({"preset": "paper", "sigma": -1.0}, "above 0"),
        ({"preset": "paper", "sigma": float("nan")}, "above 0"),
        ({"preset": "paper", "sigma": "wide"}, "a number"),
        ({"iterations": 0}, "an integer of at least 1, or None; got 0"),
        ({"iterations": 1.5}, "an integer"),
        ({"iterations": True}, "an integer"),
        ({"learning_rate": 0.0}, "above 0"),
        ({"time_budget": 0}, "above 0, or None"),
        ({"device": 3}, "a text"),
        ({"encoding": "hash", "table_bits": 40}, "of at most 24"),
        ({"sigma": 3.0}, "belongs to encoding 'fourier' and does not apply"),
        ({"motion": "flow"}, "needs a network encoding: none, nerf"),
        ({"observation": "fibres"}, "observation must be one of auto, cores, pixels, frames"),
        ({"preset": "paper", "motion": "affine"}, "known: none, homography, flow, flow_tv"),
        ({"preset": "paper", "encoding": "spline"}, "needs a bundle model"),
        ({"preset": "paper", "canvas": "union"}, "canvas must be frame"),
        ({"fill": 1}, "true or false"),
        ({"held_out": 0.7}, "of at most 0.5"),
    ],
)
def test_bad_choices_are_refused_with_what_is_known(choices, said):
    with pytest.raises(SettingsError, match=said):
        choose(**choices)


def test_numbers_of_other_kinds_become_pythons_own():
    settings = choose("paper", seed=np.int64(3), sigma=Fraction(3, 2), iterations=np.uint8(4))
    assert [type(value) for value in (settings.seed, settings.method.encoding.sigma, settings.method.iterations)] == [
        int,
        float,
        int,
    ]
    assert settings == choose("paper", seed=3, sigma=1.5, iterations=4)


def test_a_settings_object_refuses_a_part_that_is_none():
    with pytest.raises(SettingsError, match="one of NoMotion, Translation"):
        NetworkMethod(motion="homography")


@pytest.mark.parametrize("motion", MOTIONS)
@pytest.mark.parametrize("encoding", ENCODING_NAMES)
def test_settings_survive_json(motion, encoding):
    if encoding == "spline" and motion.startswith("flow"):
        encoding = "fourier"
    settings = choose(motion=motion, encoding=encoding, iterations=5)
    assert Settings.from_dict(json.loads(json.dumps(settings.to_dict()))) == settings


@pytest.mark.parametrize("motion", PUBLISHED_MOTIONS)
def test_published_settings_survive_json(motion):
    settings = choose("paper", motion=motion)
    assert Settings.from_dict(json.loads(json.dumps(settings.to_dict()))) == settings


def test_the_observation_decides_what_a_homography_is():
    assert choose(motion="homography").method.motion == Homography()
    assert choose("paper", motion="homography").method.motion == HomographyNetwork()
    assert choose(observation="frames").method.motion == HomographyNetwork()
    assert choose("paper", observation="auto").method.motion == Homography()
    assert choose("paper", observation="cores").method.encoding == Fourier(sigma=5.0)


@pytest.mark.parametrize("owner", [Settings, *METHODS.values(), *MOTIONS.values(), *ENCODINGS.values()])
def test_every_knob_tells_what_it_does(owner):
    for knob in knobs_of(owner).values():
        assert knob.doc.endswith(".")
        assert knob.allows(knob.default)
