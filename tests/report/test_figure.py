"""A figure for a paper: what is on it, in pixels of the PNG and in elements of the SVG."""

import base64
import xml.etree.ElementTree as ET
from dataclasses import replace
from io import BytesIO

import numpy as np
import pytest
from PIL import Image

from napari_fiberburst import Burst, write_figure, write_report
from napari_fiberburst.cli import main
from napari_fiberburst.data.canvas import Canvas
from napari_fiberburst.errors import OutputError
from napari_fiberburst.report import sheet as sheet_module

SVG, LINK = "{http://www.w3.org/2000/svg}", "{http://www.w3.org/1999/xlink}href"
HEIGHT, WIDTH = 31, 37


@pytest.fixture
def burst(tiny_simulation):
    """Return 5 grey frames, 0.25 micrometres a pixel."""
    return Burst(tiny_simulation.arrays()["frames"][..., 1], pixel_size=0.25, unit="µm")


@pytest.fixture
def result(fit, burst):
    """Return a result whose image is a ramp from 40 to 240 on a larger and finer canvas."""
    canvas = Canvas.over((-3, 0, WIDTH + 3, HEIGHT + 5), scale=2)
    image = np.broadcast_to(np.linspace(40, 240, canvas.shape[1], dtype=np.float32), canvas.shape).copy()
    image[:4, :4] = np.nan
    made = fit(burst, iterations=1)
    return replace(made, image=image, canvas=canvas, quality="doubtful", resolution=4.0, frames_used=(0, 1, 4))


def pictures_and_words(path):
    """Return the pictures of an SVG with their places, and all of its words in one."""
    root = ET.parse(path).getroot()
    pictures = [
        (
            np.asarray(Image.open(BytesIO(base64.b64decode(element.get(LINK).split(",")[1])))),
            {name: float(element.get(name)) for name in ("x", "y", "width", "height")},
        )
        for element in root.iter(f"{SVG}image")
    ]
    return root, pictures, " ".join(element.text for element in root.iter(f"{SVG}text"))


def test_both_pictures_are_at_the_same_scale_and_contrast(result, burst, tmp_path):
    _, ((before, at_before), (after, at_after)), _ = pictures_and_words(
        write_figure(result, burst, tmp_path / "figure.svg")
    )
    assert at_before["width"] / WIDTH == pytest.approx(at_before["height"] / HEIGHT)
    assert at_after["width"] / (WIDTH + 6) == pytest.approx(at_before["width"] / WIDTH, rel=1e-4)
    assert at_after["height"] / (HEIGHT + 5) == pytest.approx(at_before["width"] / WIDTH, rel=1e-4)
    frame = 255 * burst.frames[0, ..., 0]
    low, high = min(np.percentile(frame, 0.1), 40), max(np.percentile(frame, 99.9), 240)
    np.testing.assert_allclose(before, np.clip(255 * (frame - low) / (high - low), 0, 255), atol=1.5)
    np.testing.assert_allclose(after[10, :, 0], 255 * (result.image[10] - low) / (high - low), atol=2)
    # What is empty is see-through.
    assert after[0, 0, 1] == 0
    assert after[10, 10, 1] == 255


def test_its_scale_bars_are_as_long_as_they_say(result, burst, tmp_path):
    root, ((_, at_before), (_, at_after)), words = pictures_and_words(
        write_figure(result, burst, tmp_path / "figure.svg")
    )
    _, *bars = root.iter(f"{SVG}rect")
    for bar, at in zip(bars, (at_before, at_after), strict=True):
        assert float(bar.get("width")) == pytest.approx(2 / 0.25 * at_before["width"] / WIDTH, rel=1e-4)
        assert at["x"] < float(bar.get("x")) < at["x"] + at["width"]
        assert at["y"] < float(bar.get("y")) < at["y"] + at["height"]
    assert "2 µm" in words
    pixels = Burst(burst.frames[..., 0])
    in_pixels = replace(result, acquisition=pixels.acquisition)
    assert "10 px" in pictures_and_words(write_figure(in_pixels, pixels, tmp_path / "pixels.svg"))[2]


def test_another_burst_is_not_shown_beside_a_result(result, burst, tmp_path):
    other = Burst(burst.frames[:-1], black_level=0, white_level=1)
    for write, name in ((write_figure, "figure.svg"), (write_report, "report.html")):
        with pytest.raises(OutputError, match=r"from another burst \(5 frames"):
            write(result, other, tmp_path / name)
        assert not (tmp_path / name).exists()


def test_its_caption_says_what_the_image_rests_on(result, burst, tmp_path):
    root, _, words = pictures_and_words(write_figure(result, burst, tmp_path / "figure.svg"))
    for said in (
        "Frame 0 of a burst of 5",
        "reconstructed from 3 of them",
        "4.0 px = 1 µm",
        "Verdict: doubtful.",
        "Scale bars: 2 µm.",
    ):
        assert said in words
    width = float(root.get("viewBox").split()[2])
    assert max(len(element.text) for element in root.iter(f"{SVG}text")) * 0.5 * 16 < width
    told_less = replace(result, quality=None, resolution=None, frames_used=None, reference=2)
    words = pictures_and_words(write_figure(told_less, burst, tmp_path / "less.svg"))[2]
    assert "Frame 2 of a burst of 5" in words
    assert "Resolution" not in words
    assert "Verdict: not judged." in words


def test_a_png_shows_the_same_in_300_dots_an_inch(result, burst, tmp_path):
    _, places, _ = pictures_and_words(write_figure(result, burst, tmp_path / "figure.svg"))
    with Image.open(write_figure(result, burst, tmp_path / "figure.png")) as page:
        assert page.width == 2000
        assert page.info["dpi"][0] == pytest.approx(300, abs=0.1)
        pixels = np.asarray(page.convert("L"), dtype=float)
    for picture, at in places:
        shown = picture if picture.ndim == 2 else picture[..., 0]
        height, width = shown.shape
        for row, column in ((5, 9), (height // 2, width // 2), (9, width - 3)):
            y = 2 * (at["y"] + (row + 0.5) / height * at["height"])
            x = 2 * (at["x"] + (column + 0.5) / width * at["width"])
            assert pixels[round(y), round(x)] == pytest.approx(shown[row, column], abs=1)
    assert pixels[2, 2] == 255  # paper
    # Words stand above and below the pictures, and what is empty in the image is paper.
    above, below = places[0][1]["y"], max(at["y"] + at["height"] for _, at in places)
    assert pixels[: round(2 * above) - 2].min() < 128
    assert pixels[round(2 * below) + 2 :].min() < 128
    assert pixels[round(2 * places[1][1]["y"]) + 3, round(2 * places[1][1]["x"]) + 3] == 255


def test_an_image_of_more_pixels_makes_a_finer_png(result, burst, tmp_path):
    canvas = Canvas.over((0, 0, WIDTH, HEIGHT), scale=40)
    fine = replace(result, image=np.tile(np.float32([[0, 255], [255, 0]]), (620, 740)), canvas=canvas)
    with Image.open(write_figure(fine, burst, tmp_path / "figure.png")) as page:
        assert page.width == 4000
        assert page.info["dpi"][0] == pytest.approx(600, abs=0.1)


def test_colours_stay_and_other_channels_are_shown_as_their_mean(fit, tiny_simulation, tmp_path):
    frames = tiny_simulation.arrays()["frames"]
    for channels, ndim, said in ((3, 3, False), (2, 2, True)):
        burst = Burst(frames[..., :channels])
        path = write_figure(fit(burst, iterations=1), burst, tmp_path / "figure.svg")
        _, ((before, _), (after, _)), words = pictures_and_words(path)
        assert before.ndim == after.ndim == ndim
        assert ("the mean of 2 channels" in words) == said


def test_units_can_be_read_where_no_font_has_their_letters(result, burst, tmp_path, monkeypatch):
    written = []
    monkeypatch.setattr(sheet_module, "_FONTS", ())
    sheet_module._font.cache_clear()
    draw = sheet_module.ImageDraw.ImageDraw.text
    monkeypatch.setattr(
        sheet_module.ImageDraw.ImageDraw,
        "text",
        lambda self, at, words, **look: (written.append(words), draw(self, at, words, **look)),
    )
    write_figure(result, burst, tmp_path / "figure.png")
    sheet_module._font.cache_clear()
    assert "2 um" in written
    assert all(words.isascii() for words in written)


def test_the_command_line_writes_a_figure(tmp_path, capsys):
    source, figure = str(tmp_path / "tissue.burst"), tmp_path / "figure.svg"
    assert main(["simulate", "-o", source, "--shape", "63x71", "--frames", "5", "--pitch", "4"]) == 0
    assert main(["reconstruct", source, "--figure", str(figure)]) == 0
    assert f"wrote {figure}" in capsys.readouterr().out
    assert "Frame 0 of a burst of 5" in pictures_and_words(figure)[2]


def test_places_that_cannot_be_written_are_refused_before_the_run(tmp_path, capsys, result, burst):
    for place, said in ((tmp_path / "figure.pdf", ".png or .svg"), (tmp_path / "nowhere" / "f.svg", "does not exist")):
        assert main(["reconstruct", str(tmp_path / "none.npz"), "--figure", str(place)]) == 2
        assert said in capsys.readouterr().err
        with pytest.raises(OutputError, match=said):
            write_figure(result, burst, place)
    assert list(tmp_path.iterdir()) == []
