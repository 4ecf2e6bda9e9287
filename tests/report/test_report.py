"""A report: that it stands alone, has every part, and says what users name as they named it."""

import re
import shlex
from dataclasses import replace
from html import escape

import numpy as np
import pytest
from tests.browser import faults_of, look_at

from napari_fiberburst import Burst, Settings, load, reconstruct, write_report
from napari_fiberburst.cli import main
from napari_fiberburst.errors import OutputError
from napari_fiberburst.report.figures import Chart, round_below, ticks
from napari_fiberburst.simulation import simulate

PARTS = (
    "Before and after",
    "What the image rests on",
    "Resolution.",
    "Residual of each frame.",
    "Way of the frames.",
    "Error while it was fitted.",
    "Coverage.",
    "Uncertainty.",
    "Residual of each core.",
    "Settings",
    "Where it comes from",
)


@pytest.fixture(scope="module")
def burst():
    """Return 8 grey frames of 75 x 83 pixels of half a micrometre."""
    frames = simulate("histology", shape=(75, 83), frames=8, pitch=5.0, physics="core", channels=1, seed=2).burst.frames
    return Burst(np.rint(255 * frames[..., 0]).astype(np.uint8), pixel_size=0.5, unit="µm")


@pytest.fixture(scope="module")
def result(burst):
    """Return its reconstruction."""
    return reconstruct(burst, device="cpu")


@pytest.fixture
def told(result, burst, tmp_path):
    """Return what a browser shows of the report."""
    write_report(result, burst, tmp_path / "report.html", name="probe.tif")
    return look_at(tmp_path, ["report.html"])[0]["report.html"]


def test_it_stands_alone_and_has_every_part(result, burst, tmp_path):
    path = write_report(result, burst, tmp_path / "report.html")
    assert faults_of(tmp_path, ["report.html"]) == []
    page = path.read_text(encoding="utf-8")
    for part in PARTS:
        assert part in page, part
    assert page.count('<svg class="picture"') == 5
    assert page.count('<svg class="chart"') == 4
    assert not re.search(r"""(?:src|href)=["'](?!data:)""", page)


def test_it_says_what_the_result_says(told, result):
    assert "Good: nothing in the burst speaks against the image" in told["text"] or result.quality != "good"
    for said in (
        f"8 of {len(result.homographies)}",
        f"{result.resolution:.1f} px = {result.resolution / 2:.3g} µm",
        f"{len(result.bundle.centres)} cores",
        "torch",
        "10 µm",  # the scale bar: a quarter of 83 pixels, at most, as a round number
    ):
        assert said in told["text"], said
    for name in result.settings.flat():
        assert name in told["text"]


def test_the_call_of_a_report_repeats_the_run(result, burst, tmp_path, told):
    (call,) = told["listings"]
    document = re.search(r"from_dict\((.*)\)\n", call)
    assert document is not None
    settings = Settings.from_dict(eval(document[1]))
    assert settings == result.requested
    np.testing.assert_array_equal(reconstruct(burst, preset=settings).image, result.image)


def test_what_users_name_is_shown_and_not_run(result, burst, tmp_path):
    wicked = "<script>alert('x')</script> & \"burst\""
    named = replace(result, notes=(wicked,), quality="doubtful", acquisition=replace(result.acquisition, unit=wicked))
    write_report(named, burst, tmp_path / "report.html", name=wicked, call=f"call {wicked}")
    seen = look_at(tmp_path, ["report.html"])[0]["report.html"]
    assert seen["title"].startswith(wicked)
    assert seen["text"].count(wicked) > 3  # the heading, the note, and scales
    assert seen["listings"] == [f"call {wicked}"]
    assert "Doubtful" in seen["text"]
    assert "<script" not in (tmp_path / "report.html").read_text(encoding="utf-8")


@pytest.mark.parametrize("choices", [{"motion": "none"}, {"motion": "flow"}])
def test_a_method_that_tells_less_has_a_report_that_says_so(fit, tiny_burst, tmp_path, choices):
    path = write_report(fit(tiny_burst, **choices), tiny_burst, tmp_path / "report.html")
    page = path.read_text(encoding="utf-8")
    assert "Not judged" in page
    assert page.count("Not shown, because") == 2
    assert faults_of(tmp_path, ["report.html"]) == []


def test_what_was_left_out_is_named(result, burst, tmp_path):
    homographies = result.homographies.copy()
    homographies[3] = np.nan
    used = tuple(frame for frame in range(8) if frame != 3)
    path = write_report(
        replace(result, homographies=homographies, frames_used=used, ending="stopped"), burst, tmp_path / "report.html"
    )
    page = path.read_text(encoding="utf-8")
    assert "7 of 8; left out: 3" in page
    assert "The run was stopped before its end." in page
    assert "nan" not in page.replace("provenance", "")


def test_a_single_frame_with_its_bundle_has_a_report(result, burst, tmp_path):
    one = Burst(np.rint(255 * burst.frames[0, ..., 0]).astype(np.uint8))
    of_one = reconstruct(one, bundle=result.bundle, device="cpu")
    assert write_report(of_one, one, tmp_path / "report.html").stat().st_size > 1000
    assert faults_of(tmp_path, ["report.html"]) == []


def test_a_result_keeps_how_its_halves_agree(result, tmp_path):
    assert result.agreement.resolution == result.resolution
    assert result.agreement.correlation[0] > 0.9
    again = load(result.save(tmp_path / "scene.npz"), device="cpu")
    np.testing.assert_array_equal(again.agreement.frequency, result.agreement.frequency)
    np.testing.assert_array_equal(again.agreement.correlation, result.agreement.correlation)
    assert again.agreement.resolution == result.resolution


def test_the_command_line_writes_a_report_with_its_own_call(tmp_path, capsys):
    source = str(tmp_path / "tissue.burst")
    assert main(["simulate", "-o", source, "--shape", "63x71", "--frames", "5", "--pitch", "4"]) == 0
    command = ["reconstruct", source, "--report", str(tmp_path / "report.html"), "--seed", "3"]
    assert main(command) == 0
    assert "report.html" in capsys.readouterr().out
    assert sorted(path.name for path in tmp_path.iterdir()) == ["report.html", "tissue.burst"]
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert "<h1>tissue.burst</h1>" in page
    assert f"<pre>{escape(shlex.join(['fiberburst', *command]))}</pre>" in page


def test_places_that_cannot_be_written_are_refused_before_the_run(tmp_path, capsys, result, burst):
    for options, said in (
        (["--report", str(tmp_path / "report.pdf")], "ending in .html"),
        (["--report", str(tmp_path / "nowhere" / "report.html")], "does not exist"),
        ([], "add -o image.ome.tif, --report report.html or --figure figure.svg"),
    ):
        assert main(["reconstruct", str(tmp_path / "none.npz"), *options]) == 2
        assert said in capsys.readouterr().err
    with pytest.raises(OutputError, match=r"ending in \.html"):
        write_report(result, burst, tmp_path / "report.pdf")


def test_numbers_on_axes_are_round():
    assert ticks(0, 1) == [0, 0.2, 0.4, 0.6, 0.8, 1]
    assert ticks(3, -0.1) == [0, 0.5, 1, 1.5, 2, 2.5, 3]
    assert ticks(-0.7, 1.7, least=1) == [0, 1]
    assert [round_below(value) for value in (0.7, 1, 3, 49.9, 5000)] == [0.5, 1, 2, 20, 5000]


def test_a_curve_has_a_gap_where_a_value_is_missing():
    chart = Chart("error", "step", "error", (0, 4), (0.01, 1), log_y=True)
    chart.line([0, 1, 2, 3, 4], [1, 0.1, np.nan, 0.1, 0.01])
    drawn = re.search(r'class="curve" d="([^"]*)"', chart.svg())
    assert drawn is not None
    assert re.sub(r"[\d. ]+", "", drawn[1]) == "MLML"
