"""Traces: what each core has seen in each frame, and the mean over each region of a picture."""

import csv
import io
from pathlib import Path

import numpy as np
import tifffile
import torch
import zarr
from numpy.typing import NDArray

from napari_fiberburst.errors import SettingsError
from napari_fiberburst.io.results import write_whole
from napari_fiberburst.operators.grid import Grid
from napari_fiberburst.recordings.traces import PART, Traces
from napari_fiberburst.recordings.track import Track


def read_regions(path: Path) -> NDArray[np.integer]:
    """Return the label image in a TIFF.

    Raises
    ------
    SettingsError
        It cannot be read.
    """
    try:
        labels: NDArray[np.integer] = tifffile.imread(path)
    except (OSError, tifffile.TiffFileError) as error:
        raise SettingsError(f"{path} cannot be read as a label image ({error}); save one as TIFF") from error
    return labels


def check_regions(labels: NDArray[np.integer], shape: tuple[int, int], where: str) -> NDArray[np.int64]:
    """Return a label image as it is used.

    Parameters
    ----------
    labels : numpy.ndarray
        (H, W), 0 where there is no region.
    shape : (int, int)
        H and W that it must have.
    where : str
        What it is drawn on.

    Raises
    ------
    SettingsError
        It has another shape, is not of integers, or holds no region.
    """
    image = np.asarray(labels)
    if image.dtype.kind not in "iu" or image.shape != shape:
        raise SettingsError(
            f"regions are integers on {where}, {shape[0]} x {shape[1]}; got {image.dtype} of shape {image.shape}"
        )
    if not (image > 0).any():
        raise SettingsError("the regions are empty; number their pixels 1, 2 and so on")
    return image.astype(np.int64)


def numbers_of(regions: NDArray[np.int64] | None) -> NDArray[np.int64]:
    """Return the numbers of all regions, in order."""
    if regions is None:
        return np.zeros(0, np.int64)
    found: NDArray[np.int64] = np.unique(regions[regions > 0])
    return found


def light_of_cores(
    traces: Traces, track: Track, frames: NDArray[np.int64], black: float, span: float
) -> NDArray[np.float32]:
    """Return what cores have seen (n, N, C) in original units, gains and exposures taken out; NaN where nothing."""
    samples = traces.samples(frames).without_gains(torch.from_numpy(track.gains))
    samples = samples.without_exposures(torch.from_numpy(track.exposures[frames]))
    seen = (samples.weights > 0)[..., None]
    light: NDArray[np.float32] = torch.where(seen, samples.values * span + black, torch.nan).numpy()
    return light


def light_of_regions(
    light: NDArray[np.float32],
    track: Track,
    frames: NDArray[np.int64],
    positions: torch.Tensor,
    regions: NDArray[np.int64],
    grid: Grid,
) -> NDArray[np.float32]:
    """Return the mean of what cores have seen (n, N, C) over each region, (n, R, C); NaN where none has looked.

    Regions lie on the largest piece: `regions` (H, W) on the nodes of `grid`.
    """
    numbers = numbers_of(regions)
    found = np.full((len(frames), len(numbers), light.shape[2]), np.nan, np.float32)
    points = track.points(frames, positions).double().numpy()
    columns, rows = (
        np.rint(np.nan_to_num((points[..., axis] - start), nan=-1)).astype(np.int64)
        for axis, start in enumerate((grid.x0, grid.y0))
    )
    inside = (rows >= 0) & (rows < regions.shape[0]) & (columns >= 0) & (columns < regions.shape[1])
    inside &= (track.piece[frames] == 0)[:, None] & np.isfinite(light).all(axis=2)
    labels = np.where(inside, regions[np.where(inside, rows, 0), np.where(inside, columns, 0)], 0)
    for frame, own in enumerate(labels):
        for place, number in enumerate(numbers):
            if (own == number).any():
                found[frame, place] = light[frame, own == number].mean(axis=0)
    return found


def create_traces(
    path: Path,
    count: int,
    positions: NDArray[np.float32],
    channels: int,
    numbers: NDArray[np.int64],
    *,
    is_grey: bool,
    times: NDArray[np.float64] | None,
) -> None:
    """Make a Zarr group for traces with nothing in it: NaN.

    Parameters
    ----------
    path : Path
        Of the group.
    count : int
        Frames, T.
    positions : numpy.ndarray
        (N, 2) as (x, y), cores in frame pixels.
    channels : int
        C.
    numbers : numpy.ndarray
        (R,), of the regions.
    is_grey : bool
        Without the axis of channels.
    times : numpy.ndarray or None
        (T,) seconds.
    """
    group = zarr.open_group(path, mode="w", zarr_format=3)
    last, name = ((), ()) if is_grey else ((channels,), ("channel",))
    for what, many in (("core", len(positions)), ("region", len(numbers))):
        if not many:
            continue
        group.create_array(
            f"{what}s",
            shape=(count, many, *last),
            chunks=(PART, many, *last),
            dtype=np.float32,
            fill_value=np.nan,
            dimension_names=("time", what, *name),
        )
    group.create_array("core_positions", data=positions)
    if len(numbers):
        group.create_array("region_numbers", data=numbers)
    if times is not None:
        group.create_array("seconds", data=times)


def write_rows(path: Path, what: str, first: int, rows: NDArray[np.float32]) -> None:
    """Write rows of a table of traces, (n, M, C), from frame `first` on."""
    array = zarr.open_array(path / what, mode="r+")
    array[first : first + len(rows)] = rows if array.ndim == 3 else rows[..., 0]


def write_table(path: Path, traces: Path, times: NDArray[np.float64] | None, channel_names: tuple[str, ...]) -> None:
    """Write the traces of regions as CSV: frame, seconds, and a column for each region and channel."""
    group = zarr.open_group(traces, mode="r")
    values = np.asarray(zarr.open_array(traces / "regions", mode="r")[:])
    numbers = np.asarray(group["region_numbers"][:]).tolist()  # type: ignore[index]
    columns = [f"region_{number}" for number in numbers]
    if values.ndim == 3:
        names = channel_names or tuple(map(str, range(values.shape[2])))
        columns = [f"{column}_{name}" for column in columns for name in names]
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["frame", "seconds", *columns])
    for number, row in enumerate(values.reshape(len(values), -1)):
        seconds = "" if times is None else repr(float(times[number]))
        writer.writerow([number, seconds, *("" if np.isnan(value) else f"{value:.7g}" for value in row.tolist())])
    with write_whole(path) as stream:
        stream.write(text.getvalue().encode())
