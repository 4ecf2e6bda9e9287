"""The model file: what is read back, without the burst, is the result that was saved."""

import json
import struct
from dataclasses import fields, is_dataclass, replace
from functools import cache, partial

import numpy as np
import pytest
import safetensors.numpy

from napari_fiberburst import Bundle, Control, load, reconstruct, write_report
from napari_fiberburst.errors import OutputError, SettingsError
from napari_fiberburst.results.diagnostics import Diagnostics
from napari_fiberburst.results.model import Model
from napari_fiberburst.simulation import Faults, simulate

NETWORK = {"scene_width": 16, "scene_layers": 2, "iterations": 5}


def small(frames=5, channels=1, **faults):
    """Return a burst of single cores on 43 x 51 pixels."""
    made = Faults(**faults) if faults else None
    return simulate(
        "cat", shape=(43, 51), frames=frames, pitch=5.0, physics="core", channels=channels, faults=made
    ).burst


def stopped():
    """Return what was there when a run was stopped after its first preview."""
    control = Control()
    return reconstruct(small(), device="cpu", preview_every=1e-9, control=control, on_progress=lambda _: control.stop())


CASES = {
    "grey": lambda fit: reconstruct(small(), device="cpu"),
    "rgb": lambda fit: reconstruct(small(channels=3), device="cpu", upsample=1.5, canvas="union", fill=True),
    "bent": lambda fit: reconstruct(
        small(7, deformation=2.0, deformation_length=30.0), device="cpu", motion="deformable", smoothness=0.01
    ),
    "left out": lambda fit: reconstruct(small(), device="cpu", leave_out=(0, 1)),
    "marks": lambda fit: reconstruct(small(7, overlay=True, flicker=0.1, black_frames=1), device="cpu"),
    "no first frame": lambda fit: reconstruct(_dark_at_first(), device="cpu"),
    "one frame": lambda fit: reconstruct(
        small(1), device="cpu", bundle=Bundle.from_image(np.full((43, 51), 9) * _flat(), device="cpu")
    ),
    "no bundle": lambda fit: reconstruct(
        np.random.default_rng(0).integers(0, 99, (3, 33, 41), dtype=np.uint8), device="cpu"
    ),
    "stopped": lambda fit: stopped(),
    "published": lambda fit: fit(small(channels=3)),
    "published, still": lambda fit: fit(small(), motion="none", encoding="hash"),
    "published, flow": lambda fit: fit(small(), motion="flow_tv", encoding="siren"),
    "published, octaves": lambda fit: fit(small(), encoding="nerf"),
    "published, no encoding": lambda fit: fit(small(), encoding="none"),
    "network": lambda fit: reconstruct(small(channels=3), device="cpu", encoding="fourier", features=16, **NETWORK),
    "network, still": lambda fit: reconstruct(small(), device="cpu", encoding="hash", motion="none", **NETWORK),
    "network, flow": lambda fit: reconstruct(
        small(), device="cpu", encoding="siren", motion="flow", motion_width=16, motion_layers=1, **NETWORK
    ),
}


def _dark_at_first():
    """Return frames of which the first one shows nothing, so that another is the reference."""
    frames = np.array(small(7).frames)
    frames[0] = 0.001 * np.random.default_rng(0).random(frames[0].shape)
    return frames[..., 0]


def _flat():
    return simulate("cat", shape=(43, 51), frames=1, pitch=5.0, physics="core", channels=1).transmission


@pytest.fixture(scope="module")
def made(fit):
    """Return a function that gives the result of a case, which is made once."""
    return cache(lambda name: CASES[name](fit))


@pytest.fixture(scope="module", params=CASES)
def result(request, made):
    return made(request.param)


@pytest.fixture(scope="module")
def grey(made):
    return made("grey")


@pytest.fixture(scope="module")
def bent(made):
    return made("bent")


@pytest.fixture
def kept(grey, tmp_path):
    return grey.save(tmp_path / "cat.fiberburst")


def assert_same(one, other, name="result"):
    """Assert that two values are the same, to the bit."""
    if is_dataclass(one):
        assert type(one) is type(other), name
        for item in fields(one):
            if item.name not in ("renderer", "solver"):
                assert_same(getattr(one, item.name), getattr(other, item.name), f"{name}.{item.name}")
    elif isinstance(one, np.ndarray):
        assert one.dtype == other.dtype, name
        np.testing.assert_array_equal(one, other, err_msg=name)
    else:
        assert one == other or (one != one and other != other), name


def test_all_that_a_result_has_comes_back_to_the_bit(result, tmp_path):
    again = load(result.save(tmp_path / "scene.fiberburst"), "cpu")
    assert_same(result, again)
    assert json.loads(json.dumps(again.provenance())) == json.loads(json.dumps(result.provenance()))
    assert again.compression == result.compression
    assert again.bends == result.bends
    assert again.solver is None


def test_it_draws_the_same_pixels(result, tmp_path):
    again = load(result.save(tmp_path / "scene.fiberburst"), "cpu")
    near = {"rtol": 1e-6, "atol": 1e-6}
    np.testing.assert_allclose(again.render(2.3, (-3.5, 4, 47, 39)), result.render(2.3, (-3.5, 4, 47, 39)), **near)
    for t in range(len(result.homographies)):
        np.testing.assert_allclose(again.frame(t, 1.7), result.frame(t, 1.7), **near)
        np.testing.assert_allclose(again.flow(t), result.flow(t), **near)
        np.testing.assert_allclose(again.displacement(t), result.displacement(t), **near)


def test_it_can_be_saved_again(result, tmp_path):
    first = result.save(tmp_path / "first.fiberburst")
    second = load(first, "cpu").save(tmp_path / "second.fiberburst")
    assert Model.load(first).digest() == Model.load(second).digest()


def test_the_cases_have_what_they_are_to_test(made, bent, grey):
    assert bent.bends
    assert np.nanmax(np.abs(bent.displacement(3))) > 0.1
    assert not [item.name for item in fields(Diagnostics) if getattr(grey, item.name) is None]
    assert np.isnan(made("left out").image).any()
    assert made("rgb").image.shape[2] == 3
    assert made("stopped").ending == "stopped"
    assert made("no first frame").reference > 0
    assert made("published, flow").bends


def test_networks_go_on_from_a_model(fit, tiny_burst, tmp_path):
    first = fit(tiny_burst, iterations=60, learning_rate=3e-3)
    again = load(first.save(tmp_path / "scene.fiberburst"), "cpu")
    assert again.renderer.drawn == first.renderer.drawn > 0
    longer = fit(tiny_burst, initial=again, iterations=5, learning_rate=3e-3)
    assert len(longer.losses) == 65
    assert longer.losses[60:].mean() < first.losses[:5].mean()


def test_a_report_is_made_of_a_model_and_its_burst(grey, kept, tmp_path):
    told = write_report(load(kept, "cpu"), small(), tmp_path / "report.html").read_text()
    assert "Where it comes from" in told


def test_a_bundle_is_improved_by_a_model(grey, kept):
    again = load(kept, "cpu")
    bundle = Bundle.from_image(np.rint(200 * _flat()).astype(np.uint8), device="cpu")
    assert again.bundle.updated(again).digest() == grey.bundle.updated(grey).digest()
    assert bundle.shape == again.bundle.shape


def test_what_needs_the_burst_says_so(kept):
    with pytest.raises(SettingsError, match="run the burst anew"):
        load(kept, "cpu").solve_again(smoothness=0.1)


def test_the_file_is_of_the_public_format_tells_its_versions_and_holds_no_pickle(grey, kept):
    arrays = safetensors.numpy.load_file(kept)
    np.testing.assert_array_equal(arrays["image"], grey.image)
    np.testing.assert_array_equal(arrays["diagnostics.bundle.transmission"], grey.bundle.transmission)
    header = header_of(kept.read_bytes())["__metadata__"]
    assert header["format"] == "napari-fiberburst model"
    assert header["version"] == "1"
    told = json.loads(header["values"])
    assert set(told["made_with"]["versions"]) >= {"python", "numpy", "torch", "napari-fiberburst"}
    assert told["settings"]["seed"] == 0


def test_versions_are_those_it_was_made_with(grey, tmp_path):
    old = {"software": "napari-fiberburst", "versions": {"torch": "1.0"}}
    again = load(replace(grey, made_with=old).save(tmp_path / "old.fiberburst"), "cpu")
    again.save(tmp_path / "image.ome.tif")
    assert json.loads((tmp_path / "image.json").read_text())["versions"] == {"torch": "1.0"}


def header_of(whole):
    return json.loads(whole[8 : 8 + struct.unpack("<Q", whole[:8])[0]])


def rewritten(path, change):
    """Write a model again, with its values changed and its digest made to match, as who means harm would."""
    change(Model.load(path)).save(path)


def test_bytes_that_are_damaged_anywhere_are_refused(kept):
    whole, random, said = kept.read_bytes(), np.random.default_rng(3), []
    good = load(kept, "cpu")
    length = 8 + struct.unpack("<Q", whole[:8])[0]
    places = [*random.integers(0, length, 60), *random.integers(0, len(whole), 90)]
    for number, place in enumerate(places):
        other = bytes(random.integers(0, 256, 16, dtype=np.uint8))
        tail = (b"", bytes([whole[place] ^ 1 << number % 8]) + whole[place + 1 :], other + whole[place + 16 :])
        kept.write_bytes(whole[:place] + tail[number % 3])
        try:
            again = load(kept, "cpu")
        except OutputError as error:
            said.append(str(error))
        else:
            assert_same(again, good)  # where padding was hit, or a byte was replaced by itself
    assert len(said) > 140
    assert all(str(kept) in one for one in said)


@pytest.mark.parametrize(
    "content", [b"", b"hello", b"\x89PNG\r\n\x1a\n" + bytes(99), struct.pack("<Q", 2**62) + b"{}", bytes(4096)]
)
def test_what_is_no_model_is_refused(tmp_path, content):
    (tmp_path / "scene.fiberburst").write_bytes(content)
    with pytest.raises(OutputError, match=r"scene\.fiberburst is no model, or is damaged"):
        load(tmp_path / "scene.fiberburst")


def test_a_bundle_under_the_name_of_a_model_is_refused(grey, tmp_path):
    grey.bundle.save(tmp_path / "probe.bundle").rename(tmp_path / "probe.fiberburst")
    with pytest.raises(OutputError, match="of format 'napari-fiberburst bundle'; expected 'napari-fiberburst model'"):
        load(tmp_path / "probe.fiberburst")


def _with(name, value):
    return lambda model: replace(model, **{name: value})


def _told(name, value):
    return lambda model: replace(model, diagnostics=replace(model.diagnostics, **{name: value}))


def _taken(model, **change):
    return replace(model, acquisition={**model.acquisition, **change})


def _deep(depth):
    value = 1
    for _ in range(depth):
        value = {"a": value}
    return value


@pytest.mark.parametrize(
    "change",
    [
        _with("image", np.zeros((3, 3), np.float32)),
        _with("image", np.zeros((43, 51))),
        _with("homographies", np.zeros((4, 3, 3))),
        _with("homographies", None),
        _with("losses", np.zeros((2, 2), np.float32)),
        _with("losses", "many"),
        _with("seconds", "long"),
        _with("parameters", None),
        _with("ending", "happily"),
        _with("settings", {}),
        _with("settings", _deep(500)),
        _with("requested", {"method": {"name": "spline", "motion": {"name": "sideways"}}}),
        _with("acquisition", {}),
        _with("made_with", None),
        _with("made_with", {"software": "another"}),
        _with("homographies", np.full((5, 3, 3), np.nan)),
        _with("drawn_from", {}),
        _with("drawn_from", {"scene": np.zeros(3)}),
        _told("coverage", np.zeros((9, 9), np.float32)),
        _told("residuals", np.zeros((5, 2), np.float32)),
        _told("outliers", np.zeros((5, 2), bool)),
        _told("exposures", np.zeros(2)),
        _told("quality", "splendid"),
        _told("frames_used", (0, 99)),
        _told("reference", 7),
        _told("reference", -1),
        _told("notes", (1, 2)),
        _told("misfit", "small"),
        _with("seconds", float("nan")),
        _with("homographies", np.zeros((5, 3, 3))),
        partial(_taken, shape=(10**12, 43, 51, 1)),
        partial(_taken, shape=(5, 10**9, 10**9, 1)),
        *(
            partial(_taken, **change)
            for change in (
                {"axes": "CTYX"},
                {"dtype": "object"},
                {"white_level": float("nan")},
                {"channel_names": [1]},
                {"pixel_size": 2},
                {"pixel_size": (0, 1)},
                {"unit": 3},
                {"times": [0, 1]},
                {"origin": ("a", "b")},
                {"origin": (10**400, 0)},
            )
        ),
        lambda model: replace(model, canvas=replace(model.canvas, reference_from_image=np.zeros((3, 3)))),
        lambda model: replace(model, canvas=replace(model.canvas, shape=(10**9, 10**9))),
        lambda model: replace(model, canvas=replace(model.canvas, reference_from_image=np.full((3, 3), np.nan))),
        lambda model: replace(
            model,
            diagnostics=replace(
                model.diagnostics,
                bundle=replace(model.diagnostics.bundle, labels=model.diagnostics.bundle.labels + 1000),
            ),
        ),
    ],
)
def test_contents_that_do_not_belong_together_are_refused(kept, change):
    rewritten(kept, change)
    with pytest.raises(OutputError, match=r"cat\.fiberburst"):
        load(kept, "cpu")


@pytest.mark.parametrize(
    "size",
    [{"scene_width": 2**14, "scene_layers": 64}, {"scene_layers": 3}, {"motion_width": 2**14}, {"features": 2**16}],
)
def test_networks_that_claim_to_be_huge_take_no_memory(fit, tmp_path, size):
    path = fit(small()).save(tmp_path / "scene.fiberburst")
    model = Model.load(path)
    method = json.loads(json.dumps(model.settings["method"]))
    for part in (method, method["motion"], method["encoding"]):
        part.update({name: value for name, value in size.items() if name in part})
    replace(model, settings={**model.settings, "method": method}).save(path)
    with pytest.raises(OutputError, match="not those of the networks"):
        load(path, "cpu")


def test_frames_that_claim_to_be_huge_are_refused(fit, tmp_path):
    path = fit(small()).save(tmp_path / "scene.fiberburst")
    rewritten(path, partial(_taken, shape=(5, 10**6, 10**6, 1)))
    with pytest.raises(OutputError, match="268,435,456 values"):
        load(path, "cpu")


@pytest.mark.parametrize(
    ("name", "value"), [("scene_from_frame", 0), ("scene_from_frame", np.inf), ("control", np.inf), ("control_grid", 0)]
)
def test_frames_that_bend_without_sense_are_refused(bent, tmp_path, name, value):
    path = bent.save(tmp_path / "bent.fiberburst")
    whole = Model.load(path)
    replace(whole, drawn_from={**whole.drawn_from, name: np.full_like(whole.drawn_from[name], value)}).save(path)
    with pytest.raises(OutputError, match=r"bent\.fiberburst"):
        load(path, "cpu")


@pytest.mark.parametrize("name", ["scene", "known", "nodes", "drawing", "homographies"])
def test_scenes_that_make_no_sense_are_refused(kept, name):
    whole = Model.load(kept)
    array = whole.drawn_from[name]
    for other in (np.array(3.0), array[:0], array[:1], np.full_like(array, 1).astype(np.float64) * np.nan):
        replace(whole, drawn_from={**whole.drawn_from, name: other}).save(kept)
        try:
            again = load(kept, "cpu")
        except OutputError:
            continue
        assert not np.isinf(again.render()).any()  # some may be nothing, such as a scene of which nothing is known
