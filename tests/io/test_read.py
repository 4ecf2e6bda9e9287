"""Reading bursts: every format, and everything that can be wrong with a file."""

import struct
import zlib

import imageio.v3 as iio
import numpy as np
import pytest
import tifffile
import zarr

from napari_fiberburst import read_burst
from napari_fiberburst.errors import BurstError


@pytest.fixture
def frames(rng):
    return rng.integers(0, 256, (12, 17, 23), dtype=np.uint8)


@pytest.fixture
def colour(rng):
    return rng.integers(0, 4096, (4, 17, 23, 3)).astype(np.uint16)


def assert_holds(burst, frames):
    expected = frames[..., None] if frames.ndim == 3 else frames
    np.testing.assert_allclose(burst.frames * burst.white_level, expected, atol=1e-2)
    assert burst.dtype == frames.dtype


def test_multi_page_tiff(tmp_path, frames):
    tifffile.imwrite(tmp_path / "burst.tif", frames, photometric="minisblack")
    assert_holds(read_burst(tmp_path / "burst.tif"), frames)


def test_pages_that_know_nothing_of_one_another(tmp_path, frames):
    with tifffile.TiffWriter(tmp_path / "burst.tif") as writer:
        for frame in frames:
            writer.write(frame, contiguous=False, metadata=None)
    assert_holds(read_burst(tmp_path / "burst.tif"), frames)


def test_rgb_pages(tmp_path, rng):
    frames = rng.integers(0, 256, (4, 17, 23, 3), dtype=np.uint8)
    tifffile.imwrite(tmp_path / "burst.tif", frames, photometric="rgb")
    assert_holds(read_burst(tmp_path / "burst.tif"), frames)


def test_ome_tiff_with_what_it_knows(tmp_path, colour):
    metadata = {
        "axes": "TCYX",
        "PhysicalSizeX": 0.5,
        "PhysicalSizeXUnit": "µm",
        "PhysicalSizeY": 0.75,
        "PhysicalSizeYUnit": "µm",
        "Channel": {"Name": ["red", "green", "blue"]},
        "TimeIncrement": 0.25,
        "TimeIncrementUnit": "s",
    }
    tifffile.imwrite(tmp_path / "burst.ome.tif", np.moveaxis(colour, 3, 1), metadata=metadata, photometric="minisblack")
    burst = read_burst(tmp_path / "burst.ome.tif")
    assert_holds(burst, colour)
    assert burst.pixel_size == (0.75, 0.5)
    assert burst.unit == "µm"
    assert burst.channel_names == ("red", "green", "blue")
    np.testing.assert_allclose(burst.times, [0, 0.25, 0.5, 0.75])


def test_imagej_tiff_with_what_it_knows(tmp_path, frames):
    tifffile.imwrite(
        tmp_path / "burst.tif",
        frames,
        imagej=True,
        resolution=(2.0, 4.0),
        metadata={"axes": "TYX", "unit": "um", "finterval": 0.1},
    )
    burst = read_burst(tmp_path / "burst.tif")
    assert_holds(burst, frames)
    assert burst.pixel_size == pytest.approx((0.25, 0.5))
    assert burst.unit == "µm"
    np.testing.assert_allclose(burst.times, 0.1 * np.arange(12))


def test_pages_that_are_a_series_each(tmp_path, frames):
    with tifffile.TiffWriter(tmp_path / "burst.tif") as writer:
        for frame in frames:
            writer.write(frame)
    assert_holds(read_burst(tmp_path / "burst.tif"), frames)


def test_pages_of_two_sizes_are_refused(tmp_path, frames):
    with tifffile.TiffWriter(tmp_path / "burst.tif") as writer:
        writer.write(frames, photometric="minisblack")
        writer.write(frames[:3, :16, :16], photometric="minisblack")
    with pytest.raises(BurstError, match=r"pages of different sizes or types, \(12, 17, 23\), \(3, 16, 16\)"):
        read_burst(tmp_path / "burst.tif")


def test_a_palette_stands_for_its_colours(tmp_path, rng):
    indices = rng.integers(0, 256, (3, 17, 23), dtype=np.uint8)
    colormap = rng.integers(0, 65536, (3, 256)).astype(np.uint16)
    tifffile.imwrite(tmp_path / "burst.tif", indices, photometric="palette", colormap=colormap)
    assert_holds(read_burst(tmp_path / "burst.tif"), np.moveaxis(colormap[:, indices], 0, -1))


def test_alpha_is_no_light(tmp_path, rng):
    frames = rng.integers(0, 256, (3, 17, 23, 4), dtype=np.uint8)
    tifffile.imwrite(tmp_path / "burst.tif", frames, photometric="rgb", extrasamples=["unassalpha"])
    assert_holds(read_burst(tmp_path / "burst.tif"), frames[..., :3])


@pytest.mark.parametrize("kind", ["ome", "imagej"])
def test_frames_along_z_keep_their_times(tmp_path, frames, kind):
    if kind == "ome":
        metadata = {"axes": "ZYX", "TimeIncrement": 100.0, "TimeIncrementUnit": "ms"}
        tifffile.imwrite(tmp_path / "burst.tif", frames, ome=True, metadata=metadata, photometric="minisblack")
    else:
        tifffile.imwrite(tmp_path / "burst.tif", frames, imagej=True, metadata={"axes": "ZYX", "finterval": 0.1})
    burst = read_burst(tmp_path / "burst.tif")
    assert_holds(burst, frames)
    np.testing.assert_allclose(burst.times, 0.1 * np.arange(12))


def test_metadata_that_cannot_be_is_left_out(tmp_path, frames, caplog):
    zero = {"axes": "TYX", "PhysicalSizeX": 0.0, "PhysicalSizeY": 0.0}
    tifffile.imwrite(tmp_path / "ome.tif", frames, ome=True, metadata=zero, photometric="minisblack")
    tifffile.imwrite(tmp_path / "odd.tif", frames, ome=True, metadata={"axes": "TYX", "TimeIncrementUnit": "yd"})
    tifffile.imwrite(
        tmp_path / "ij.tif", frames, imagej=True, resolution=((0, 1), (0, 1)), metadata={"axes": "TYX", "unit": "um"}
    )
    for name in ("ome.tif", "odd.tif", "ij.tif"):
        burst = read_burst(tmp_path / name)
        assert_holds(burst, frames)
        assert burst.pixel_size is None
    assert "ignoring" in caplog.text


def test_axes_can_be_corrected(tmp_path, colour):
    tifffile.imwrite(tmp_path / "burst.tif", np.moveaxis(colour, 3, 0), photometric="minisblack")
    assert_holds(read_burst(tmp_path / "burst.tif", axes="CTYX"), colour)


@pytest.mark.parametrize("ending", ["png", "tif"])
def test_a_folder_in_natural_order(tmp_path, frames, ending):
    for index, frame in enumerate(frames):
        iio.imwrite(tmp_path / f"frame{index}.{ending}", frame)  # frame10 sorts before frame2 by letters
    (tmp_path / "notes.txt").write_text("not a frame")
    assert_holds(read_burst(tmp_path), frames)


def test_a_folder_of_tiffs_with_channels(tmp_path, colour):
    for index, frame in enumerate(colour):
        planes = np.moveaxis(frame, 2, 0)
        tifffile.imwrite(tmp_path / f"{index}.ome.tif", planes, metadata={"axes": "CYX"}, photometric="minisblack")
    assert_holds(read_burst(tmp_path), colour)


def test_a_folder_of_stacks_is_refused(tmp_path, frames):
    for index in range(3):
        tifffile.imwrite(tmp_path / f"{index}.tif", frames, photometric="minisblack")
    with pytest.raises(BurstError, match="must hold one frame, got shape"):
        read_burst(tmp_path)


def test_hidden_files_and_folders_are_passed_over(tmp_path, frames):
    for index, frame in enumerate(frames):
        iio.imwrite(tmp_path / f"{index}.png", frame)
    (tmp_path / "._0.png").write_bytes(b"notes of some system")
    (tmp_path / "old.tif").mkdir()
    assert_holds(read_burst(tmp_path), frames)


def test_a_pattern(tmp_path, frames):
    for index, frame in enumerate(frames):
        iio.imwrite(tmp_path / f"a{index}.png", frame)
    iio.imwrite(tmp_path / "b0.png", frames[0][:-1])
    assert_holds(read_burst(str(tmp_path / "a*.png")), frames)


def test_rgb_png_frames(tmp_path, rng):
    frames = rng.integers(0, 256, (3, 17, 23, 3), dtype=np.uint8)
    for index, frame in enumerate(frames):
        iio.imwrite(tmp_path / f"{index}.png", frame)
    assert_holds(read_burst(tmp_path), frames)


def test_png_of_16_bits_and_with_alpha(tmp_path, rng):
    grey = rng.integers(0, 65536, (3, 17, 23)).astype(np.uint16)
    (tmp_path / "grey").mkdir()
    (tmp_path / "alpha").mkdir()
    colour = rng.integers(0, 256, (3, 17, 23, 4), dtype=np.uint8)
    for index in range(3):
        iio.imwrite(tmp_path / "grey" / f"{index}.png", grey[index])
        iio.imwrite(tmp_path / "alpha" / f"{index}.png", colour[index])
    assert_holds(read_burst(tmp_path / "grey"), grey)
    assert_holds(read_burst(tmp_path / "alpha"), colour[..., :3])


def test_colour_png_of_16_bits_is_refused_rather_than_rounded(tmp_path):
    # The smallest such image: one black pixel.
    def chunk(name, data):
        return struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))

    header = chunk(b"IHDR", struct.pack(">IIBBBBB", 1, 1, 16, 2, 0, 0, 0))
    pixels = chunk(b"IDAT", zlib.compress(bytes(7)))
    (tmp_path / "0.png").write_bytes(b"\x89PNG\r\n\x1a\n" + header + pixels + chunk(b"IEND", b""))
    with pytest.raises(BurstError, match="save it as TIFF"):
        read_burst(tmp_path)


def test_npz(tmp_path, colour):
    np.savez(tmp_path / "named.npz", frames=colour, truth=colour[0])
    np.savez(tmp_path / "only.npz", colour)
    np.savez(tmp_path / "axes.npz", frames=np.moveaxis(colour, 3, 0), axes="CTYX")
    for name in ("named", "only", "axes"):
        assert_holds(read_burst(tmp_path / f"{name}.npz"), colour)


@pytest.mark.parametrize("version", [0.4, 0.5])
def test_ome_zarr(tmp_path, colour, version):
    path = tmp_path / "burst.zarr"
    group = zarr.open_group(str(path), mode="w", zarr_format=2 if version == 0.4 else 3)
    group.create_array("0", data=np.moveaxis(colour, 3, 1))
    axes = [
        {"name": "t", "type": "time", "unit": "second"},
        {"name": "c", "type": "channel"},
        {"name": "y", "type": "space", "unit": "micrometer"},
        {"name": "x", "type": "space", "unit": "micrometer"},
    ]
    scale = [{"type": "scale", "scale": [0.5, 1, 0.75, 0.6]}]
    ome = {
        "multiscales": [{"axes": axes, "datasets": [{"path": "0", "coordinateTransformations": scale}]}],
        "omero": {"channels": [{"label": name} for name in ("r", "g", "b")]},
    }
    group.attrs.update(ome if version == 0.4 else {"ome": ome})
    burst = read_burst(path)
    assert_holds(burst, colour)
    assert burst.pixel_size == (0.75, 0.6)
    assert burst.unit == "µm"
    assert burst.channel_names == ("r", "g", "b")
    np.testing.assert_allclose(burst.times, [0, 0.5, 1, 1.5])


def test_levels_are_handed_on(tmp_path, frames):
    tifffile.imwrite(tmp_path / "burst.tif", frames, photometric="minisblack")
    burst = read_burst(tmp_path / "burst.tif", black_level=3, white_level=200)
    assert (burst.black_level, burst.white_level) == (3, 200)


@pytest.mark.parametrize("compression", ["lzw", "zlib", "deflate", "zstd", "packbits", "lzma"])
@pytest.mark.parametrize("predictor", [False, True])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_a_compressed_tiff_is_read_exactly(tmp_path, frames, compression, predictor, dtype):
    pixels = frames.astype(dtype) * (257 if dtype == np.uint16 else 1)
    if compression == "packbits" and predictor:
        pixels, predictor = pixels[:, ::-1].copy(), False  # it knows no predictor
    tifffile.imwrite(
        tmp_path / "burst.tif", pixels, photometric="minisblack", compression=compression, predictor=predictor
    )
    assert_holds(read_burst(tmp_path / "burst.tif"), pixels)


@pytest.mark.parametrize("imagej_like", [{"metadata": {"axes": "TYX"}}, {"rowsperstrip": 3}, {"tile": (16, 16)}])
def test_lzw_as_microscopes_write_it_is_read(tmp_path, frames, imagej_like):
    tifffile.imwrite(tmp_path / "burst.tif", frames, photometric="minisblack", compression="lzw", **imagej_like)
    assert_holds(read_burst(tmp_path / "burst.tif"), frames)


@pytest.mark.parametrize("channels", [1, 3])
def test_a_jpeg_compressed_tiff_is_read_to_within_its_loss(tmp_path, channels):
    y, x = np.indices((37, 31))
    smooth = 120 + 60 * np.sin(x / 9) * np.cos(y / 11)
    pixels = np.stack([smooth + 5 * number for number in range(3)]).astype(np.uint8)
    if channels == 3:
        pixels = np.stack([pixels, pixels // 2, pixels // 3], axis=-1)
    kind = "minisblack" if channels == 1 else "rgb"
    tifffile.imwrite(
        tmp_path / "burst.tif", pixels, photometric=kind, compression="jpeg", compressionargs={"level": 95}
    )
    burst = read_burst(tmp_path / "burst.tif")
    assert burst.shape == (3, 37, 31, channels)
    read = burst.frames * (burst.white_level - burst.black_level) + burst.black_level
    assert np.abs(read - pixels.reshape(burst.shape)).max() < 12


@pytest.mark.parametrize("compression", ["lzw", "zstd", "jpeg"])
def test_a_damaged_compressed_tiff_is_refused(tmp_path, frames, compression):
    path = tmp_path / "burst.tif"
    tifffile.imwrite(path, frames, photometric="minisblack", compression=compression)
    with tifffile.TiffFile(path) as file:
        start, length = file.pages[1].dataoffsets[0], file.pages[1].databytecounts[0]
    data = bytearray(path.read_bytes())
    data[start : start + length] = b"\x5a" * length
    path.write_bytes(data)
    with pytest.raises(BurstError, match=r"cannot be read as TIFF.*copy or export it again"):
        read_burst(path)


@pytest.mark.parametrize("kind", ["plain", "ome", "imagej", "compressed", "lzw", "single pages", "bigtiff"])
def test_a_tiff_cut_anywhere_is_refused_or_whole(tmp_path, frames, kind):
    whole = tmp_path / "whole.tif"
    if kind == "single pages":
        with tifffile.TiffWriter(whole) as writer:
            for frame in frames:
                writer.write(frame, contiguous=False, metadata=None)
    else:
        choices = {
            "ome": {"ome": True},
            "imagej": {"imagej": True},
            "compressed": {"compression": "zlib"},
            "lzw": {"compression": "lzw"},
            "bigtiff": {"bigtiff": True},
        }.get(kind, {})
        tifffile.imwrite(whole, frames, photometric="minisblack", **choices)
    data = whole.read_bytes()
    cut = tmp_path / "cut.tif"
    for length in {0, 3, 4, 8, 16, 100, *range(200, len(data), len(data) // 89)}:
        cut.write_bytes(data[:length])
        try:
            burst = read_burst(cut)
        except BurstError:
            continue
        assert_holds(burst, frames)  # only what follows the pixels was lost


def test_what_cannot_be_read_is_refused(tmp_path, frames):
    (tmp_path / "text.tif").write_text("hello")
    (tmp_path / "text.npz").write_text("hello")
    (tmp_path / "burst.doc").write_text("hello")
    (tmp_path / "empty").mkdir()
    (tmp_path / "broken").mkdir()
    (tmp_path / "broken" / "0.png").write_text("hello")
    (tmp_path / "ragged").mkdir()
    (tmp_path / "mixed").mkdir()
    for index, frame in enumerate(frames[:3]):
        iio.imwrite(tmp_path / "ragged" / f"{index}.png", frame[: 17 - index])
        iio.imwrite(tmp_path / "mixed" / f"{index}.png", frame.astype(np.uint16 if index == 2 else np.uint8))
    np.savez(tmp_path / "several.npz", a=frames, b=frames)
    np.savez(tmp_path / "objects.npz", frames=np.array([{}, {}], dtype=object))
    zarr.open_group(str(tmp_path / "plain.zarr"), mode="w")
    np.savez(tmp_path / "axes.npz", frames=frames, axes=np.array(3))
    np.savez(tmp_path / "level.npz", frames=frames, black_level=np.array("dark"))
    for name, said in (
        ("missing.tif", "there is no .*expected a TIFF stack"),
        ("no*.png", "holds no frames"),
        ("text.tif", "cannot be read as TIFF"),
        ("text.npz", "cannot be read as npz"),
        ("burst.doc", "of no kind that can be read"),
        ("empty", "holds no frames"),
        ("broken", "0.png cannot be read as an image"),
        ("ragged", r"all frames need one size.*1.png has \(16, 23\)"),
        ("mixed", "2.png has .* uint16"),
        ("several.npz", "named 'frames'; it has a, b"),
        ("objects.npz", "cannot be read as npz"),
        ("plain.zarr", "no OME-Zarr image"),
        ("axes.npz", "must give its axes as text"),
        ("level.npz", "levels? must be numbers"),
        ("a" * 300 + ".tif", "cannot be opened"),
    ):
        with pytest.raises(BurstError, match=said):
            read_burst(tmp_path / name)
