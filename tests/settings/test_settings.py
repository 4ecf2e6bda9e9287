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
    Affine,
    AutoMotion,
    Flow,
    FlowTV,
    Fourier,
    Hash,
    Homography,
    HomographyNetwork,
    NeRF,
    NetworkMethod,
    PublishedMethod,
    Settings,
    Siren,
    SplineMethod,
    all_keywords,
    choose,
)
from napari_fiberburst.settings.parameter import parameters_of


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
        (
            {"motion": "zoom"},
            "known: auto, none, translation, .*, homography, deformable, flow, flow_tv",
        ),
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
        ({"batch": 64}, "batch belongs to networks and does not apply to motion 'auto' with encoding 'spline'"),
        ({"encoding": "hash", "smoothness": 1.0}, "belongs to encoding 'spline' and does not apply"),
        ({"preset": "paper", "fill": True}, "belongs to a bundle model and does not apply to the published method"),
        ({"samples": "cores"}, "is no setting"),
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
    if motion.startswith("flow") and encoding == "spline":
        encoding = "fourier"
    if motion == "deformable":
        encoding = "spline"
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


def test_motion_that_is_open_is_what_is_usual_with_the_method():
    assert choose(motion="auto").method.motion == AutoMotion()
    assert choose(motion="auto", encoding="fourier").method.motion == Homography()
    assert choose("paper", motion="auto").method.motion == HomographyNetwork()
    with pytest.raises(SettingsError, match="needs encoding 'spline'; with a network, take motion 'flow'"):
        choose(motion="deformable", encoding="fourier")


def test_the_keywords_choose_the_method():
    assert choose().method == SplineMethod()
    assert choose(encoding="siren", observation="pixels").method == NetworkMethod(encoding=Siren(), samples="pixels")
    assert choose(observation="frames").method == choose("paper").method == PublishedMethod()
    assert choose(encoding="hash", observation="frames").method == PublishedMethod(encoding=Hash())
    assert choose("paper", observation="cores", encoding="spline").method == SplineMethod(
        samples="cores", iterations=3000
    )


def test_values_that_another_method_has_too_are_carried_over():
    start = choose(motion="affine", upsample=2.0, canvas="union", smoothness=0.5, iterations=7)
    assert choose(start, encoding="nerf").method == NetworkMethod(
        motion=Affine(), encoding=NeRF(), upsample=2.0, canvas="union", iterations=7
    )
    assert choose(start, observation="frames").method == PublishedMethod(upsample=2.0, iterations=7)


def test_a_method_refuses_parts_of_another():
    with pytest.raises(SettingsError, match="motion must be one of NoMotion, HomographyNetwork, Flow, FlowTV"):
        PublishedMethod(motion=Homography())
    with pytest.raises(SettingsError, match="encoding must be one of NoEncoding"):
        NetworkMethod(encoding="spline")
    with pytest.raises(SettingsError, match="method must be one of SplineMethod, NetworkMethod, PublishedMethod"):
        Settings(method="spline")
    with pytest.raises(SettingsError, match="motion flow needs a network encoding"):
        SplineMethod(motion=Flow())


ALL_KINDS = [
    {"motion": "affine", "observation": "cores", "smoothness": 0.25, "fill": True, "time_budget": 3.0},
    {"encoding": "fourier", "motion": "flow_tv", "tv_weight": 0.5, "canvas": "union", "batch": 64, "seed": 5},
    {"preset": "paper", "encoding": "hash", "levels": 5, "learning_rate": 0.01, "device": "cpu"},
]


@pytest.mark.parametrize("choices", ALL_KINDS)
def test_the_flat_keywords_give_the_settings_back(choices):
    settings = choose(**choices)
    assert choose(**settings.flat()) == settings
    assert set(settings.flat()) == {"motion", "encoding", *settings.parameters}
    for name, value in choices.items():
        if name in settings.parameters:
            assert settings.value_of(name) == value
    with pytest.raises(SettingsError, match="is no setting"):
        settings.value_of("sgima")


def test_json_is_nested_and_tells_the_method_by_name():
    told = choose(encoding="hash", motion="flow", levels=5, seed=3).to_dict()
    assert (told["seed"], told["method"]["name"], told["method"]["samples"]) == (3, "network", "auto")
    assert told["method"]["motion"]["name"] == "flow"
    assert told["method"]["encoding"]["levels"] == 5
    assert "smoothness" not in told["method"]


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"method": None}, "method must be a mapping of names to values; got None"),
        ({"method": {"name": "wavelets"}}, "unknown method 'wavelets'; known: spline, network, published"),
        ({"method": {}}, "unknown method None"),
        ({"method": {"name": "published", "motion": {"name": "affine"}}}, "known: none, homography, flow, flow_tv"),
        ({"method": {"name": "network", "encoding": "nerf"}}, "encoding must be a mapping"),
        ({"method": {"name": "spline", "batch": 3}}, "batch is no setting of SplineMethod; known: .*smoothness"),
        ({"method": {"name": "spline", "iterations": "3"}}, "iterations must be an integer of at least 1, or None"),
        ({"speed": 3}, "speed is no setting of Settings; known: method, seed"),
        ({"seed": 1.5}, "seed must be an integer"),
    ],
)
def test_json_that_is_no_settings_is_refused(change, said):
    with pytest.raises(SettingsError, match=said):
        Settings.from_dict({**Settings().to_dict(), **change})


def test_settings_that_are_no_mapping_are_refused():
    with pytest.raises(SettingsError, match="settings must be a mapping of names to values; got 'auto'"):
        Settings.from_dict("auto")


# As version 0.1.0 wrote them: on one level, those of other methods among them.
FLAT = {"canvas": "frame", "upsample": 2.0, "fill": True, "held_out": 0.1, "scene_layers": 3, "scene_width": 64}
FLAT |= {"iterations": None, "learning_rate": None, "batch": 99, "seed": 4, "device": "cpu"}
FLAT |= {"time_budget": None, "preview_every": 2.0}


@pytest.mark.parametrize(
    ("parts", "method"),
    [
        (
            {"motion": {"name": "affine"}, "encoding": {"name": "spline", "smoothness": 0.5}, "observation": "cores"},
            SplineMethod(motion=Affine(), smoothness=0.5, samples="cores", upsample=2.0, fill=True, held_out=0.1),
        ),
        (
            {
                "motion": {"name": "flow", "motion_layers": 2, "motion_width": 8, "flow_omega_0": 3.0},
                "encoding": {"name": "fourier", "features": 8, "sigma": 1.5},
                "observation": "auto",
            },
            NetworkMethod(
                motion=Flow(motion_layers=2, motion_width=8, flow_omega_0=3.0),
                encoding=Fourier(features=8, sigma=1.5),
                upsample=2.0,
                fill=True,
                held_out=0.1,
                scene_layers=3,
                scene_width=64,
                batch=99,
            ),
        ),
        (
            {
                "motion": {"name": "homography", "motion_layers": 2, "motion_width": 8},
                "encoding": {"name": "nerf", "highest_octave": 4},
                "observation": "frames",
            },
            PublishedMethod(
                motion=HomographyNetwork(motion_layers=2, motion_width=8),
                encoding=NeRF(highest_octave=4),
                upsample=2.0,
                scene_layers=3,
                scene_width=64,
                batch=99,
            ),
        ),
    ],
)
def test_settings_of_the_first_version_are_still_read(parts, method):
    settings = Settings.from_dict({**FLAT, **parts})
    assert settings == Settings(method=method, seed=4, device="cpu", preview_every=2.0)


def test_what_is_left_open_is_named():
    assert choose().left_open == ("motion", "observation", "smoothness", "iterations", "device")
    network = choose(encoding="fourier", observation="cores", iterations=5, batch=8, device="cpu", time_budget=1.0)
    assert network.left_open == ("sigma", "learning_rate")
    assert choose("paper").left_open == ("batch", "device")
    assert choose("paper", motion="none", encoding="none", batch=8, device="cpu").left_open == ()


@pytest.mark.parametrize("choices", [{}, *ALL_KINDS])
def test_every_parameter_has_a_keyword_that_takes_its_value(choices):
    settings, known = choose(**choices), all_keywords()
    for name in settings.parameters:
        assert known[name].allows(settings.value_of(name))


@pytest.mark.parametrize("owner", [Settings, *METHODS.values(), *MOTIONS.values(), *ENCODINGS.values()])
def test_every_parameter_tells_what_it_does(owner):
    for parameter in parameters_of(owner).values():
        assert parameter.doc.endswith(".")
        assert parameter.allows(parameter.default)
