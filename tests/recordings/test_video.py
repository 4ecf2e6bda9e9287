"""Every frame of a recording from those about it, against a simulation whose truth is exact."""

import csv
import shutil
from dataclasses import replace

import numpy as np
import pytest
import zarr
from ome_zarr_models.v05.image import Image

from napari_fiberburst import open_recording, read_burst, reconstruct
from napari_fiberburst import video as make_video
from napari_fiberburst.coordinates import transform_points
from napari_fiberburst.errors import OutputError, SettingsError
from napari_fiberburst.recordings import stretch as stretches
from napari_fiberburst.recordings import video as pipeline
from napari_fiberburst.recordings.locate import locating
from napari_fiberburst.recordings.stretch import near_cores
from napari_fiberburst.recordings.traces import traced
from napari_fiberburst.simulation import simulate_recording
from napari_fiberburst.steps import drain

SHAPE, FRAMES, RIM, FLASH = (97, 121), 40, 8, 0.3


def recorded(scene, **changes):
    given = {"shape": SHAPE, "frames": FRAMES, "path": "handheld", "step": 2.0} | changes
    return simulate_recording(scene, **given)


def pixels_of(found):
    return zarr.open_array(found.path / "0", mode="r")[:]


def matched(image, truth):
    """Return an image at the brightness and level of the truth, which no reconstruction can know."""
    known = np.isfinite(image)
    slope, level = np.polyfit(image[known], truth[known], 1)
    return slope * image + level


def psnr(image, truth):
    inner = (slice(RIM, -RIM),) * 2
    return -10 * np.log10(np.nanmean((matched(image[inner], truth[inner]) - truth[inner]) ** 2))


def disc_about(recording, cell, number, radius):
    """Return which pixels of a frame lie about a cell; None where some would lie outside."""
    place = transform_points(np.linalg.inv(recording.homographies[number]), recording.cells[cell][None])[0]
    if (place < radius).any() or (place > np.array(SHAPE[::-1]) - 1 - radius).any():
        return None
    rows, columns = np.indices(SHAPE)
    return np.hypot(columns - place[0], rows - place[1]) < radius


# What happens in the tissue: nothing


@pytest.fixture(scope="module")
def still():
    return recorded("slide", seed=7)


@pytest.fixture(scope="module")
def located(still, tmp_path_factory):
    """Return where the frames lie, found once for all videos of the same recording."""
    folder = tmp_path_factory.mktemp("located")
    found = drain(locating(still.source, folder, bundle=None, dof=None, client=None))

    def again(source, folder, **given):
        if source is not still.source:
            return (yield from locating(source, folder, **given))
        shutil.copytree(found.work.folder / "traces", folder / "traces", dirs_exist_ok=True)
        work = replace(found.work, folder=folder)
        return replace(found, work=work, traces=traced(work))

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pipeline, "locating", again)
        yield


@pytest.fixture(scope="module")
def of_still(still, located, tmp_path_factory):
    return make_video(still.source, tmp_path_factory.mktemp("still") / "a.ome.zarr", window=15)


def test_frames_are_as_good_as_bursts_of_the_same_frames(still, of_still):
    frames = pixels_of(of_still)
    assert frames.shape == (FRAMES, *SHAPE)
    assert frames.dtype == np.float32
    for number in (9, 27):
        truth = still.truth([number])[0, ..., 0]
        others = [other for other in range(number - 7, number + 8) if other != number]
        alone = reconstruct(still.source.burst([number, *others]), device="cpu")
        assert psnr(frames[number], truth) > psnr(alone.image, truth) - 0.5


def test_no_pixel_is_left_out_where_one_core_is_missing():
    y, x = np.mgrid[2:60:4.0, 2:80:4.0]
    centres = np.stack([x.ravel(), y.ravel()], axis=1)
    gone = np.hypot(*(centres - (42, 30)).T) < 1
    pixels = np.stack(np.meshgrid(np.arange(81.0), np.arange(61.0)), axis=-1)
    assert near_cores(pixels, centres[~gone], 3.5).all()
    wide = np.hypot(*(centres - (42, 30)).T) < 13
    assert not near_cores(pixels, centres[~wide], 3.5)[30, 42]


def test_frames_at_the_ends_have_neighbours_too(still, of_still):
    truth, frames = still.truth(range(FRAMES))[..., 0], pixels_of(of_still)
    of_frames = [psnr(frame, seen) for frame, seen in zip(frames, truth, strict=True)]
    assert min(of_frames) > np.median(of_frames) - 3


def rim_error(frames, truth):
    """Return how far frames are from the truth in a strip along their edge, root mean square."""
    strip = np.ones(SHAPE, dtype=bool)
    strip[12:-12, 12:-12] = strip[:3] = strip[-3:] = strip[:, :3] = strip[:, -3:] = False
    off = [(matched(frame, seen) - seen)[strip] for frame, seen in zip(frames, truth, strict=True)]
    return float(np.sqrt(np.nanmean(np.square(off))))


def test_what_has_just_come_into_sight_is_settled(tmp_path, monkeypatch):
    """Each frame begins from the one before, which has not seen what lies at the rim now."""
    fast = recorded("slide", seed=5, step=6.0, frames=30)
    frames = pixels_of(make_video(fast.source, tmp_path / "a.ome.zarr", window=9))
    monkeypatch.setattr(stretches, "_ITERATIONS", 40)
    settled = pixels_of(make_video(fast.source, tmp_path / "b.ome.zarr", window=9))
    truth = fast.truth(range(30))[..., 0]
    assert rim_error(frames, truth) < 1.08 * rim_error(settled, truth)


def test_looking_for_changes_costs_nothing_where_there_are_none(still, of_still, tmp_path, monkeypatch):
    """What is drawn anew in each frame must not flicker."""
    look = stretches.find_changes
    monkeypatch.setattr(
        stretches, "find_changes", lambda *given: {frame: ~(was | ~was) for frame, was in look(*given).items()}
    )
    blind = pixels_of(make_video(still.source, tmp_path / "a.ome.zarr", window=15))
    truth = still.truth(range(FRAMES))[..., 0]
    for frame, without, seen in zip(pixels_of(of_still), blind, truth, strict=True):
        assert psnr(frame, seen) > psnr(without, seen) - 0.1


def test_a_run_that_was_cut_short_comes_to_the_same_bits(still, located, tmp_path, monkeypatch):
    monkeypatch.setattr(pipeline, "STRETCH", 16)
    monkeypatch.setattr(stretches, "STRETCH", 16)
    whole = make_video(still.source, tmp_path / "a.ome.zarr", window=5)
    work = stretches.solve_unit
    done = []

    def fails_at_last(*given):
        if len(done) == 2:
            raise KeyboardInterrupt
        work(*given)
        done.append(given)

    monkeypatch.setattr(pipeline, "solve_unit", fails_at_last)
    with pytest.raises(KeyboardInterrupt):
        make_video(still.source, tmp_path / "b.ome.zarr", window=5)
    again = []
    monkeypatch.setattr(pipeline, "solve_unit", lambda *given: again.append(given) or work(*given))
    part = make_video(still.source, tmp_path / "b.ome.zarr", window=5)
    assert len(again) == 1
    np.testing.assert_array_equal(pixels_of(part), pixels_of(whole))
    np.testing.assert_array_equal(*(zarr.open_array(one.traces / "cores")[:] for one in (part, whole)))


def test_a_stabilised_video_stands_still(still, located, tmp_path):
    found = make_video(still.source, tmp_path / "a.ome.zarr", stabilised=True)
    frames = pixels_of(found)
    assert frames.shape[1] > SHAPE[0]
    assert frames.shape[2] > SHAPE[1]
    assert np.isfinite(frames).mean() < 0.9
    both = np.isfinite(frames[3]) & np.isfinite(frames[36])
    assert np.corrcoef(frames[3][both], frames[36][both])[0, 1] > 0.98
    moved = transform_points(found.track.scene_from_frame[36], np.array([[60.0, 48.0]]))[0]
    assert np.hypot(*(moved - (60, 48))) > 2


# What happens in the tissue: cells flash


@pytest.fixture(scope="module")
def flashing():
    return recorded("fluorescence", seed=6, cells=6, flash=FLASH, gaps=1, gap_frames=3, frames=FRAMES)


@pytest.fixture(scope="module")
def labels(flashing):
    """Return the cells that frame 0 sees as regions on it, numbered from 1."""
    drawn = np.zeros(SHAPE, np.uint8)
    for cell in range(len(flashing.cells)):
        disc = disc_about(flashing, cell, 0, flashing.cell_radius)
        if disc is not None:
            drawn[disc] = cell + 1
    return drawn


@pytest.fixture(scope="module")
def of_flashing(flashing, labels, tmp_path_factory):
    folder = tmp_path_factory.mktemp("flashing")
    return make_video(flashing.source, folder / "a.ome.zarr", regions=labels, mp4=folder / "a.mp4")


def added_by_cells(recording, frames, track):
    """Return how much light there is about cells beyond what is usual there, as a part of that of a flash.

    One array of the frames in which a cell flashes, one of those up to three frames beside a flash.
    """
    placed = np.flatnonzero(track.piece >= 0)
    truth = dict(zip(placed, recording.truth(placed)[..., 0], strict=True))
    found = {"during": [], "beside": []}
    for cell, trace in enumerate(recording.traces.T):
        light = {}
        for number in placed:
            disc = disc_about(recording, cell, number, recording.cell_radius + 6)
            if disc is not None:
                light[number] = (matched(frames[number], truth[number]) - truth[number])[disc].sum()
        quiet = [value for number, value in light.items() if trace[number] == 0]
        whole = np.pi * recording.cell_radius**2 * FLASH
        for number, value in light.items():
            more = (value - np.median(quiet)) / whole if quiet else np.nan
            if trace[number] > 0:
                found["during"].append(1 + more)
            elif trace[max(0, number - 3) : number + 4].any():
                found["beside"].append(more)
    return {kind: np.array(values)[np.isfinite(values)] for kind, values in found.items()}


def test_a_flash_of_three_frames_is_in_those_frames_and_no_others(flashing, of_flashing):
    light = added_by_cells(flashing, pixels_of(of_flashing), of_flashing.track)
    assert len(light["during"]) > 15
    assert np.median(light["during"]) == pytest.approx(1, abs=0.05)
    assert light["during"].min() > 0.5
    assert abs(np.median(light["beside"])) < 0.03
    assert np.abs(light["beside"]).max() < 0.2


def test_frames_that_show_nothing_are_shown_as_they_are(flashing, of_flashing):
    """Never their neighbours' picture in their place."""
    frames, lost = pixels_of(of_flashing), of_flashing.track.piece < 0
    assert lost.any()
    assert not flashing.in_contact[lost].any()
    dark = ~flashing.in_contact & (flashing.source.values(range(FRAMES)).max(axis=(1, 2, 3)) < 0.05)
    assert dark.any()
    assert lost[dark].all()
    assert np.nanmax(np.abs(frames[dark])) < 0.2 * np.nanmax(frames)
    assert any("without a place" in note for note in of_flashing.notes)
    with of_flashing.poses.open() as stream:
        used = [row["used"] for row in csv.DictReader(stream)]
    assert [text == "0" for text in used] == lost.tolist()


def test_traces_of_regions_follow_their_cells(flashing, labels, of_flashing):
    group = zarr.open_group(of_flashing.traces, mode="r")
    values, numbers = group["regions"][:], group["region_numbers"][:]
    np.testing.assert_array_equal(numbers, np.unique(labels[labels > 0]))
    np.testing.assert_allclose(group["seconds"][:], flashing.source.acquisition.times)
    assert group["cores"].shape == (FRAMES, group["core_positions"].shape[0])
    told = 0
    for number, trace in zip(numbers, values.T, strict=True):
        expected = flashing.traces[:, number - 1]
        known = np.isfinite(trace)
        if (expected[known] > 0).sum() < 2:
            continue
        told += 1
        assert np.corrcoef(trace[known], expected[known])[0, 1] > 0.9
    assert told
    with of_flashing.table.open() as stream:
        rows = list(csv.DictReader(stream))
    column = [float(row[f"region_{numbers[0]}"] or "nan") for row in rows]
    np.testing.assert_allclose(column, values[:, 0], rtol=1e-5)
    np.testing.assert_allclose([float(row["seconds"]) for row in rows], flashing.source.acquisition.times)


# What is written


def test_the_video_is_valid_and_is_opened_as_a_recording(flashing, of_flashing):
    image = Image.from_zarr(zarr.open_group(of_flashing.path, mode="r"))
    assert [axis.name for axis in image.ome_attributes.multiscales[0].axes] == ["t", "y", "x"]
    again = open_recording(of_flashing.path)
    assert again.shape == (FRAMES, *SHAPE, 1)
    np.testing.assert_allclose(again.acquisition.times, flashing.source.acquisition.times)


def test_the_film_shows_the_same(of_flashing):
    film = read_burst(of_flashing.movie, frames=":10").frames[..., 0]
    frames = pixels_of(of_flashing)
    assert film.shape[1:] == (98, 122)  # H.264 has even sides
    assert np.corrcoef(film[5, :97, :121].ravel(), frames[5].ravel())[0, 1] > 0.98


def test_what_does_not_fit_is_refused_at_once(still, tmp_path):
    with pytest.raises(OutputError, match=r"a video is written to a folder ending in \.ome\.zarr"):
        make_video(still.source, tmp_path / "a.tif")
    with pytest.raises(OutputError, match="a video file ends in"):
        make_video(still.source, tmp_path / "a.ome.zarr", mp4=tmp_path / "a.gif")
    with pytest.raises(SettingsError, match="window must be a number of frames"):
        make_video(still.source, tmp_path / "a.ome.zarr", window=0)
    with pytest.raises(SettingsError, match=r"regions are integers on a frame, 97 x 121; got uint8 of shape \(5, 7\)"):
        make_video(still.source, tmp_path / "a.ome.zarr", regions=np.ones((5, 7), np.uint8))
    assert not list(tmp_path.iterdir())
