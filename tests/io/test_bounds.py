"""Files that would do harm: what claims more than it holds, lacks parts, or is no file, is refused unread."""

import json
import logging
import os
import re
import struct
import zipfile

import numpy as np
import pytest
import tifffile
import zarr

from napari_fiberburst import read_burst
from napari_fiberburst.errors import BurstError
from napari_fiberburst.io import open_recording
from napari_fiberburst.io.folder import read_image
from napari_fiberburst.io.pyramid import create_pyramid, write_tile

AXES = [{"name": "t", "type": "time"}, {"name": "y", "type": "space"}, {"name": "x", "type": "space"}]


@pytest.fixture
def frames(rng):
    return rng.integers(1, 256, (6, 33, 41), dtype=np.uint8)


@pytest.fixture
def little_memory(monkeypatch):
    """Let whoever takes memory for 100 million values or more fail at once."""

    def bounded(make):
        def taken(shape, *arguments, **more):
            if np.prod(np.atleast_1d(shape), dtype=float) > 1e8:
                raise AssertionError(f"memory is taken for {shape}")
            return make(shape, *arguments, **more)

        return taken

    for name in ("empty", "zeros"):
        monkeypatch.setattr(np, name, bounded(getattr(np, name)))


def claiming(path, height, width):
    """Write into a TIFF file that its pages, of one strip each, have another size."""
    data = bytearray(path.read_bytes())
    sizes = {"ImageWidth": width, "ImageLength": height, "RowsPerStrip": height}
    with tifffile.TiffFile(path) as file:
        for page in file.pages:
            for name, size in sizes.items():
                struct.pack_into("<HII", data, page.tags[name].offset + 2, 4, 1, size)
    path.write_bytes(data)


@pytest.mark.parametrize(
    ("height", "width", "said"),
    [
        (200_000, 200_000, "268,435,456 values .* at most, got 200000 x 200000"),
        (2**32 - 1, 33, "at most, got 4294967295 x 33"),
        (16_000, 15_999, "claims .* MiB of pixels in .* KiB"),
    ],
)
@pytest.mark.usefixtures("little_memory")
def test_a_tiff_that_claims_huge_pages_is_refused(tmp_path, frames, height, width, said):
    path = tmp_path / "burst.tif"
    tifffile.imwrite(path, frames, photometric="minisblack", compression="zlib", metadata=None)
    claiming(path, height, width)
    for opened in (open_recording, read_burst):
        with pytest.raises(BurstError, match=said):
            opened(path)


@pytest.mark.parametrize("sizes", [{"X": 200_000, "Y": 200_000}, {"T": 10**9}])
@pytest.mark.usefixtures("little_memory")
def test_ome_metadata_that_tell_of_more_than_there_can_be_are_refused(tmp_path, frames, sizes):
    path = tmp_path / "burst.ome.tif"
    tifffile.imwrite(path, frames, photometric="minisblack", compression="zlib", ome=True, metadata={"axes": "TYX"})
    with tifffile.TiffFile(path) as file:
        told = file.ome_metadata
    for axis, size in sizes.items():
        told = re.sub(rf'Size{axis}="\d+"', f'Size{axis}="{size}"', told)
    tifffile.imwrite(path, frames, photometric="minisblack", compression="zlib", metadata=None, description=told)
    with pytest.raises(BurstError, match=r"OME metadata of .* tell of .* where its pages have 33 x 41"):
        open_recording(path)


def test_what_says_little_is_no_bomb(tmp_path, frames):
    frames[1:] = 0
    tifffile.imwrite(tmp_path / "dark.tif", np.repeat(frames, 50, axis=0), photometric="minisblack", compression="zlib")
    assert read_burst(tmp_path / "dark.tif").shape == (300, 33, 41, 1)


@pytest.mark.usefixtures("little_memory")
def test_a_burst_that_memory_could_not_hold_is_refused(tmp_path, frames):
    path = claiming_zarr(tmp_path, frames, (3000, 1000, 999), (1, 1000, 999))
    with pytest.raises(BurstError, match=r"3000 frames of .* take 11 GiB of memory, expected 8.*choose fewer"):
        read_burst(path)


@pytest.mark.parametrize("ending", [".burst", ".npz"])
@pytest.mark.usefixtures("little_memory")
def test_an_archive_that_unpacks_to_far_more_than_it_has_is_refused(tmp_path, ending):
    path = tmp_path / f"bomb{ending}"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("frames.npy", b"\0" * 4000)
    data = path.read_bytes()
    place = data.index(b"PK\x01\x02") + 24  # where the directory tells the size of the first member
    path.write_bytes(data[:place] + struct.pack("<I", 3 * 10**9) + data[place + 4 :])
    with pytest.raises(BurstError, match=r"claims 2,861 MiB of pixels in .* KiB"):
        read_burst(path)


@pytest.mark.usefixtures("little_memory")
def test_an_array_that_claims_more_than_its_file_has_is_refused(tmp_path):
    path = tmp_path / "flat.npy"
    with path.open("wb") as stream:
        header = {"descr": "|u1", "fortran_order": False, "shape": (200_000, 200_000)}
        np.lib.format.write_array_header_1_0(stream, header)
        stream.write(b"\0" * 1000)
    with pytest.raises(BurstError, match="cannot be read as an image"):
        read_image(path)


def written_zarr(tmp_path, frames, version=3, **choices):
    path = tmp_path / "burst.ome.zarr"
    group = zarr.open_group(str(path), mode="w", zarr_format=version)
    choices = {"chunks": (1, 20, 20), "fill_value": 0, **choices}
    group.create_array("0", shape=frames.shape, dtype=frames.dtype, **choices)[:] = frames
    scale = {"type": "scale", "scale": [1.0, 1.0, 1.0]}
    image = {"axes": AXES, "datasets": [{"path": "0", "coordinateTransformations": [scale]}]}
    told = {"multiscales": [image]}
    group.attrs.update(told if version == 2 else {"ome": told})
    return path


def claiming_zarr(tmp_path, frames, shape, chunks):
    path = written_zarr(tmp_path, frames, chunks=(1, 33, 41))
    told = json.loads((path / "0" / "zarr.json").read_text())
    told["shape"], told["chunk_grid"]["configuration"]["chunk_shape"] = shape, chunks
    (path / "0" / "zarr.json").write_text(json.dumps(told))
    return path


@pytest.mark.parametrize(
    ("shape", "chunks", "said"),
    [
        ((2, 20_000, 20_000), (2, 20_000, 20_000), "claims 763 MiB of pixels in 8 KiB"),
        ((2, 20_000, 20_000), (1, 33, 20_000), "268,435,456 values .* at most, got 20000 x 20000"),
        ((3000, 1000, 999), (3000, 1000, 999), "chunks of 2,858 MiB.*expected 2,048 at most"),
        ((10**12, 33, 41), (1, 33, 41), "6 of its 1000000000000 chunks, which is next to nothing"),
        ((6, 16_000, 15_999), (1, 16_000, 15_999), "claims 1,465 MiB of pixels"),
    ],
)
@pytest.mark.usefixtures("little_memory")
def test_a_zarr_that_claims_more_than_it_holds_is_refused(tmp_path, frames, shape, chunks, said):
    path = claiming_zarr(tmp_path, frames, shape, chunks)
    for opened in (open_recording, read_burst):
        with pytest.raises(BurstError, match=said):
            opened(path)


@pytest.mark.parametrize(
    ("version", "choices", "key"),
    [(2, {}, "3.0.1"), (3, {}, "c/3/0/1"), (3, {"shards": (2, 40, 60)}, "c/1/0/0")],
)
def test_chunks_of_a_zarr_that_are_not_there_are_named(tmp_path, frames, version, choices, key, caplog):
    path = written_zarr(tmp_path, frames, version, **choices)
    with caplog.at_level(logging.WARNING):
        read_burst(path)
    assert not caplog.records
    (path / "0" / key).unlink()
    read_burst(path)
    assert f"are not there ({key}) and count as 0" in caplog.text
    assert re.search(r"1 of (36|3) chunks", caplog.text)


def test_a_zarr_without_chunks_is_refused(tmp_path, frames):
    path = written_zarr(tmp_path, np.zeros_like(frames))
    with pytest.raises(BurstError, match="0 of its 36 chunks"):
        read_burst(path)


def test_chunks_that_stand_for_nan_are_no_loss(tmp_path, caplog):
    path = tmp_path / "mosaic.ome.zarr"
    create_pyramid(path, (300, 301), name="mosaic")
    write_tile(path, (0, 256), (0, 256), np.ones((256, 256), np.float32))
    with caplog.at_level(logging.WARNING):
        pixels = open_recording(path).recorded([0])
    assert not caplog.records
    assert np.isfinite(pixels).sum() == 256 * 256


@pytest.mark.parametrize("name", ["x.tif", "x.png", "x.npz", "x.burst", "x.avi", "x.npy"])
def test_what_is_no_file_is_refused_rather_than_waited_for(tmp_path, name):
    os.mkfifo(tmp_path / name)
    (tmp_path / f"zero{name}").symlink_to("/dev/zero")
    for path in (tmp_path / name, tmp_path / f"zero{name}"):
        opened = read_image if name == "x.npy" else open_recording
        said = "expected the file of an image" if name == "x.npy" else "is a pipe or a device|no kind that can be read"
        with pytest.raises(BurstError, match=said):
            opened(path)
    if name in ("x.tif", "x.png"):
        with pytest.raises(BurstError, match="is a pipe or a device"):
            open_recording([tmp_path / name])
        with pytest.raises(BurstError, match="is a pipe or a device"):
            open_recording(tmp_path / "x.*")


@pytest.mark.parametrize("name", ["zarr.json", "0/zarr.json", "0/c/2/0/1"])
def test_a_zarr_with_a_pipe_in_it_is_refused(tmp_path, frames, name):
    path = written_zarr(tmp_path, frames)
    (path / name).unlink()
    os.mkfifo(path / name)
    with pytest.raises(BurstError, match="is a pipe or a device"):
        open_recording(path)


def test_strips_that_were_never_written_are_not_taken_for_black(tmp_path, rng):
    path = tmp_path / "sparse.tif"
    frames = rng.integers(0, 255, (3, 41, 53), np.uint8)
    tifffile.imwrite(path, frames, rowsperstrip=16, compression="zlib", photometric="minisblack")
    with tifffile.TiffFile(path, mode="r+") as file:
        counts = file.pages[1].tags["StripByteCounts"]
        counts.overwrite((counts.value[0], 0, counts.value[2]))
    with pytest.raises(BurstError, match="parts of it are missing; copy or export it again"):
        read_burst(path)


@pytest.mark.parametrize(("pages", "back"), [(1, 0), (3, 1), (150, 20)])
def test_pages_that_lead_back_to_one_another_are_refused(tmp_path, pages, back):
    path = tmp_path / "ring.tif"
    with tifffile.TiffWriter(path) as writer:
        for number in range(pages):
            writer.write(np.full((19, 23), number, np.uint8), contiguous=False, metadata=None)
    with tifffile.TiffFile(path) as file:
        offsets = [page.offset for page in file.pages]
        last, layout = offsets[-1], file.tiff
    whole = bytearray(path.read_bytes())
    (tags,) = struct.unpack_from(layout.tagnoformat, whole, last)
    struct.pack_into(layout.offsetformat, whole, last + layout.tagnosize + tags * layout.tagsize, offsets[back])
    path.write_bytes(whole)
    with pytest.raises(BurstError, match="lead back to one another, and have no end; export it again"):
        read_burst(path)
