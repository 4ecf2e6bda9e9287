"""Mosaics end to end: pictures and tables against the simulator's truth, and what is said of bad recordings."""

import csv
from dataclasses import replace

import numpy as np
import pytest
import zarr
from ome_zarr_models.v05 import Image
from scipy.ndimage import binary_erosion
from tests.recordings.conftest import SHAPE, after_similarity, middles

from napari_fiberburst.coordinates import transform_points
from napari_fiberburst.data.burst import Acquisition
from napari_fiberburst.data.source import FrameSource
from napari_fiberburst.errors import BurstError, FiberBurstError, OutputError
from napari_fiberburst.io.pyramid import coarsen, create_pyramid, write_tile
from napari_fiberburst.quality import psnr
from napari_fiberburst.recordings import mosaic as mosaics
from napari_fiberburst.recordings.mosaic import mosaic, mosaicking
from napari_fiberburst.simulation import simulate_recording
from napari_fiberburst.steps import drain


def table(made):
    with made.poses.open(newline="") as file:
        return list(csv.DictReader(file))


def placed(made):
    rows = table(made)
    piece = np.array([int(row["piece"] or -1) for row in rows])
    matrices = np.array([[float(row[f"h{i}{j}"] or "nan") for i in range(3) for j in range(3)] for row in rows])
    return piece, matrices.reshape(-1, 3, 3)


def pixels(path, name=""):
    return np.asarray(zarr.open_array(path / name / "0", mode="r"))


def fidelity(made, recording, piece):
    """Return PSNR of a piece's picture where it lies by the best similarity, a core distance inside its rim."""
    pieces, matrices = placed(made)
    frames = np.flatnonzero(pieces == piece)
    _, (turn, shift) = after_similarity(middles(matrices[frames]), middles(recording.homographies[frames]))
    picture = pixels(made.paths[piece]) / 255
    known = binary_erosion(np.isfinite(picture), np.ones((11, 11)))
    y, x = np.nonzero(known)
    points = turn * (x + 1j * y) + shift
    truth = recording.world.sample(np.stack([points.real, points.imag], axis=1))[:, 0]
    return psnr(picture[known][None], truth[None])


def gain_error(bundle, recording):
    """Return the spread of cores' brightness about the true one, relative, common factor aside."""
    true = replace(bundle, transmission=recording.transmission.astype(np.float32)).brightness
    inner = ((bundle.centres > 6) & (bundle.centres < np.array(bundle.shape[::-1]) - 7)).all(axis=1)
    ratio = (bundle.brightness / np.maximum(true, 1e-9))[inner & (true > 0.1)]
    return ratio.std() / ratio.mean()


def test_the_bundle_is_better_known_by_all_frames(made, hand, located):
    assert made.bundle.gains_known
    assert gain_error(made.bundle, hand) < 0.5 * gain_error(located.work.bundle, hand)


def test_a_bundle_that_was_known_is_made_better(made, hand, rng):
    """Its gains are 10 % off, and rest on little light."""
    wrong = np.append(1 + 0.1 * rng.standard_normal(len(made.bundle.centres)), 1).astype(np.float32)
    known = replace(
        made.bundle,
        transmission=made.bundle.transmission * wrong[made.bundle.labels],
        gain_weights=np.full(len(made.bundle.centres), 0.5, np.float32),
    )
    assert gain_error(known, hand) > 0.08
    better = known.updated(made)
    assert gain_error(better, hand) < 0.03
    assert (better.gain_weights >= known.gain_weights).all()


def test_frames_lie_where_they_were(made, hand):
    pieces, matrices = placed(made)
    for piece in range(len(made.paths)):
        frames = np.flatnonzero(pieces == piece)
        true = middles(hand.homographies[frames])
        off = np.abs(after_similarity(middles(matrices[frames]), true)[0] - true)
        assert np.median(off) < 0.12
        # Frames that were lifted off a little are blurred, and lie less well.
        assert off[hand.in_contact[frames]].max() < 0.6


def test_a_gap_and_a_cut_make_pieces_that_are_named_and_told(made, hand):
    pieces, _ = placed(made)
    cut = int(hand.cuts[0])
    assert [path.name for path in made.paths] == ["wide.ome.zarr", "wide-2.ome.zarr"][: len(made.paths)]
    assert len(made.paths) == 2
    assert set(pieces[:cut]) & set(pieces[cut:]) <= {-1}
    assert (pieces == -1).sum() <= 10
    assert any("2 pieces" in note for note in made.notes)
    assert any("show nothing" in note or "could not be placed" in note for note in made.notes)
    assert not made.poses.with_name("wide.work").exists()


def test_the_picture_is_nearly_what_true_places_make(made, hand, located, tmp_path, monkeypatch):
    track = located.track
    matrices = track.scene_from_frame.copy()
    for piece in range(track.pieces):
        frames = track.frames_of(piece)
        matrices[frames] = np.linalg.inv(hand.homographies[frames[0]]) @ hand.homographies[frames]
    true = replace(located, track=replace(track, scene_from_frame=matrices, control=None))

    def known(*given, **named):
        yield from ()
        return true

    monkeypatch.setattr(mosaics, "locating", known)
    best = mosaic(hand.source, tmp_path / "true.ome.zarr")
    assert fidelity(made, hand, 0) > 24
    assert fidelity(made, hand, 0) > fidelity(best, hand, 0) - 0.8


def test_the_table_leads_from_frames_to_the_picture(made, hand):
    pieces, matrices = placed(made)
    frame = int(np.flatnonzero((pieces == 0) & hand.in_contact)[8])
    picture = pixels(made.paths[0])
    inner = np.stack(np.meshgrid(np.arange(12, SHAPE[1] - 12), np.arange(12, SHAPE[0] - 12)), axis=-1).reshape(-1, 2)
    at = np.rint(transform_points(matrices[frame], inner.astype(float))).astype(int)
    seen = picture[at[:, 1], at[:, 0]]
    truth = hand.truth([frame])[0, inner[:, 1], inner[:, 0], 0]
    assert np.isfinite(seen).all()
    assert np.corrcoef(seen, truth)[0, 1] > 0.95
    beside = picture[at[:, 1], np.clip(at[:, 0] + 4, 0, picture.shape[1] - 1)]
    known = np.isfinite(beside)
    assert np.corrcoef(beside[known], truth[known])[0, 1] < 0.9
    assert float(table(made)[frame]["seconds"]) == pytest.approx(frame / 25)


def test_nothing_is_drawn_where_nothing_was_seen(made, hand):
    pieces, matrices = placed(made)
    picture, coverage, frames = (pixels(made.paths[0], name) for name in ("", "coverage", "frames"))
    deviation = pixels(made.paths[0], "uncertainty")
    assert picture.shape == coverage.shape == frames.shape == deviation.shape
    y, x = np.indices(picture.shape)
    count = np.zeros(picture.shape, int)
    for frame in np.flatnonzero(pieces == 0):
        back = transform_points(np.linalg.inv(matrices[frame]), np.stack([x, y], axis=-1).reshape(-1, 2).astype(float))
        count += ((back > -0.5) & (back < np.array(SHAPE[::-1]) - 0.5)).all(axis=1).reshape(picture.shape)
    far = ~binary_erosion(count == 0, np.ones((15, 15)), border_value=1) | (count > 0)
    assert np.isnan(picture[~far]).all()
    assert (count == 0).any()
    inside = binary_erosion(count > 0, np.ones((15, 15)))
    assert np.isfinite(picture[inside]).mean() > 0.999
    np.testing.assert_array_equal(np.isnan(deviation), np.isnan(picture))
    assert (deviation[inside] > 0).all()
    # A frame is counted where its cores are, which end before its edge.
    assert (frames <= count + 2).all()
    assert (frames > count + 1).mean() < 1e-3
    assert np.abs(frames - count)[inside].mean() < 1.5
    assert np.corrcoef(frames[inside], coverage[inside])[0, 1] > 0.5
    assert (coverage >= 0).all()


def test_the_picture_is_ome_zarr(made):
    for path in made.paths:
        for part in (path, path / "coverage", path / "uncertainty", path / "frames"):
            image = Image.from_zarr(zarr.open_group(part, mode="r"))
            assert [axis.name for axis in image.ome_attributes.multiscales[0].axes] == ["y", "x"]


@pytest.mark.parametrize("shape", [(701, 530), (3, 301, 513)])
def test_pyramids_say_how_large_pixels_are_and_where(tmp_path, shape, rng):
    create_pyramid(tmp_path / "a", shape, name="a", pixel_size=(0.5, 0.25), unit="micrometer")
    written = rng.normal(size=(*shape[:-2], 256, 256)).astype(np.float32)
    write_tile(tmp_path / "a", (0, 256), (256, 512), written)
    coarsen(tmp_path / "a")
    image = Image.from_zarr(zarr.open_group(tmp_path / "a", mode="r"))
    scales = image.ome_attributes.multiscales[0]
    assert [axis.unit for axis in scales.axes][-2:] == ["micrometer"] * 2
    lead = len(shape) - 2
    for level, dataset in enumerate(scales.datasets):
        scale, translation = (part.model_dump() for part in dataset.coordinateTransformations)
        factor = 2**level
        assert scale["scale"][lead:] == [0.5 * factor, 0.25 * factor]
        # The middle of the first pixel is that of the pixels that it stands for.
        assert translation["translation"][lead:] == [0.5 * (factor - 1) / 2, 0.25 * (factor - 1) / 2]
    first = np.asarray(zarr.open_array(tmp_path / "a" / "1", mode="r"))
    mean = written.reshape(*shape[:-2], 128, 2, 128, 2).mean(axis=(-3, -1))
    np.testing.assert_allclose(first[..., :128, 128:256], mean, rtol=1e-5)
    assert np.isnan(first[..., 128:, :]).all()
    assert first.shape[-2:] == tuple(-(-side // 2) for side in shape[-2:])


@pytest.fixture(scope="module")
def short():
    return simulate_recording(frames=24, shape=(61, 83), path="raster", step=4.0, pitch=4.0, seed=2)


def test_work_that_was_cut_short_goes_on_to_the_same_bits(short, tmp_path):
    whole = mosaic(short.source, tmp_path / "whole.ome.zarr")
    stops = 0
    for most in (2, 3, 4):
        steps = mosaicking(short.source, tmp_path / "cut.ome.zarr", bundle=None, dof=None, client=None)
        for _ in range(most):
            if next(steps, None) is None:
                break
        else:
            stops += 1
        steps.close()
    assert stops >= 2
    assert (tmp_path / "cut.work").exists()
    cut = mosaic(short.source, tmp_path / "cut.ome.zarr")
    assert cut.poses.read_bytes() == whole.poses.read_bytes()
    np.testing.assert_array_equal(pixels(cut.paths[0]), pixels(whole.paths[0]))


def test_other_work_in_the_same_place_is_not_taken_over(short, tmp_path):
    steps = mosaicking(short.source, tmp_path / "a.ome.zarr", bundle=None, dof=None, client=None)
    next(steps)
    steps.close()
    with pytest.raises(OutputError, match="dof was None, is 2"):
        mosaic(short.source, tmp_path / "a.ome.zarr", dof=2)


def test_places_that_cannot_be_written(short, tmp_path):
    with pytest.raises(OutputError, match=r"\.ome\.zarr"):
        mosaic(short.source, tmp_path / "a.tif")
    (tmp_path / "there.ome.zarr").mkdir()
    with pytest.raises(OutputError, match="is there already"):
        mosaic(short.source, tmp_path / "there.ome.zarr")


class Frames:
    """Reads frames of an array."""

    def __init__(self, frames):
        self.frames = frames

    def __call__(self, numbers):
        return self.frames[list(numbers)]


def source_of(frames):
    known = Acquisition(
        shape=frames.shape, axes="TYX", dtype=frames.dtype, black_level=0.0, white_level=255.0, times=None
    )
    return FrameSource(acquisition=known, reader=Frames(frames), name="frames", fingerprint="0")


@pytest.mark.parametrize("what", ["no overlap", "one frame", "black", "still"])
def test_recordings_that_make_no_mosaic(what, short, tmp_path):
    if what == "no overlap":
        path = np.tile(np.eye(3), (8, 1, 1))
        path[:, 0, 2] = 200.0 * np.arange(8)
        source = simulate_recording(shape=(61, 83), path=path, pitch=4.0, seed=2).source
    elif what == "one frame":
        source = short.source.take([0])
    elif what == "black":
        source = source_of(np.zeros((12, 61, 83, 1), np.uint8))
    else:
        source = simulate_recording(shape=(61, 83), path=np.tile(np.eye(3), (12, 1, 1)), pitch=4.0, seed=2).source
    with pytest.raises(FiberBurstError) as caught:
        mosaic(source, tmp_path / "a.ome.zarr")
    assert isinstance(caught.value, BurstError)
    assert len(str(caught.value)) > 30
    assert not (tmp_path / "a.ome.zarr").exists()


def test_progress_comes_in_parts_of_a_step(short, tmp_path):
    steps = mosaicking(short.source, tmp_path / "a.ome.zarr", bundle=None, dof=2, client=None)
    told = []
    drain(_telling(steps, told))
    assert {doing.what for doing in told} >= {
        "reading frames",
        "looking for neighbours",
        "refining",
        "solving the scene",
    }
    assert all(0 <= doing.part <= 1 for doing in told)


def _telling(steps, told):
    while True:
        try:
            doing = next(steps)
        except StopIteration as ended:
            return ended.value
        told.append(doing)
        yield doing


def test_a_path_gone_time_and_again_is_shown_no_worse_than_gone_once(tmp_path):
    shown = []
    for laps in (1, 8):
        truth = simulate_recording(frames=30 * laps, shape=SHAPE, path="raster", step=5.0, laps=laps, seed=6)
        shown.append(fidelity(mosaic(truth.source, tmp_path / f"{laps}.ome.zarr"), truth, 0))
    assert shown[1] > shown[0] - 0.7
