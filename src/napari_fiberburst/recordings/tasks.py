"""What can be done with every recording of a folder: a mosaic, a video, or one image of a good burst."""

from collections.abc import Callable, Generator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import zarr
from numpy.typing import NDArray

from napari_fiberburst.bundle.bundle import Bundle
from napari_fiberburst.data.source import FrameSource
from napari_fiberburst.errors import OutputError, SettingsError
from napari_fiberburst.io.pyav import import_av
from napari_fiberburst.pipeline.choose import best_burst
from napari_fiberburst.pipeline.reconstruct import reconstruct
from napari_fiberburst.recordings.mosaic import mosaicking
from napari_fiberburst.recordings.regions import read_regions
from napari_fiberburst.recordings.video import videoing
from napari_fiberburst.recordings.work import Doing
from napari_fiberburst.settings import choose
from napari_fiberburst.settings.freedom import FREEDOM

# Where more than this part of the frames has a place, the result may be good; where less than that has, it is bad.
_MOST_PLACED, _LEAST_PLACED = 0.9, 0.5

Settings = Mapping[str, Any]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Made:
    """What a task has made of a recording."""

    outputs: tuple[Path, ...]
    verdict: str
    notes: tuple[str, ...]
    facts: tuple[str, ...]
    picture: NDArray[np.floating]


def _mosaic(
    source: FrameSource, folder: Path, bundle: Bundle | None, settings: Settings, client: Any | None
) -> Generator[Doing, None, Made]:
    dof = FREEDOM[settings.get("motion", "auto")]
    made = yield from mosaicking(source, folder / "mosaic.ome.zarr", bundle=bundle, dof=dof, client=client)
    placed, count = int((made.track.piece == 0).sum()), len(made.track)
    group = zarr.open_group(made.paths[0], mode="r")
    coarsest = np.asarray(group[str(sum(1 for _ in group.array_keys()) - 1)])
    facts = [f"{placed} of {count} frames in the picture"]
    if made.resolution is not None:
        facts.append(f"resolves periods of {made.resolution:.1f} px")
    return Made(
        outputs=(*made.paths, made.poses),
        verdict=_verdict(placed / count, made.quality),
        notes=made.notes,
        facts=tuple(facts),
        picture=_channels_last(coarsest),
    )


def _video(
    source: FrameSource, folder: Path, bundle: Bundle | None, settings: Settings, client: Any | None
) -> Generator[Doing, None, Made]:
    labels, remarks = _regions(settings, folder.name)
    made = yield from videoing(
        source,
        folder / "video.ome.zarr",
        bundle=bundle,
        dof=FREEDOM[settings.get("motion", "auto")],
        window=settings.get("window"),
        stabilised=settings.get("stabilised", False),
        regions=labels,
        mp4=folder / "video.mp4" if settings.get("mp4", False) else None,
        scale_bar=settings.get("scale_bar", False),
        client=client,
    )
    placed, count = int((made.track.piece >= 0).sum()), len(made.track)
    frames = zarr.open_array(made.path / "0", mode="r")
    return Made(
        outputs=tuple(
            path for path in (made.path, made.poses, made.traces, made.table, made.movie) if path is not None
        ),
        verdict=_verdict(placed / count, made.quality),
        notes=(*made.notes, *remarks),
        facts=(f"{placed} of {count} frames have a place", f"{made.window} frames stand behind each"),
        picture=_channels_last(np.asarray(frames[count // 2])),
    )


def _regions(settings: Settings, recording: str) -> tuple[NDArray[np.integer] | None, tuple[str, ...]]:
    """Return the regions of a recording, where it has any: one file for all, or one that is called as the recording."""
    if "regions" not in settings:
        return None, ()
    path = Path(settings["regions"])
    if not path.is_dir():
        return read_regions(path), ()
    own = path / f"{Path(recording).stem}.tif"
    return (read_regions(own), ()) if own.exists() else (None, (f"without regions, because there is no {own}",))


def _burst(
    source: FrameSource, folder: Path, bundle: Bundle | None, settings: Settings, client: Any | None
) -> Generator[Doing, None, Made]:
    choices = dict(settings)
    chosen = best_burst(source, choices.pop("frames", 20))
    yield Doing("reconstructing", left=1)
    result = reconstruct(source.burst(chosen), bundle=bundle, **choices)
    path = result.save(folder / "image.ome.tif")
    return Made(
        outputs=(path,),
        verdict=result.quality or "not judged",
        notes=tuple(result.notes),
        facts=(f"frames {chosen.start} to {chosen.stop - 1} of {len(source)}",),
        picture=result.image,
    )


def _verdict(placed: float, quality: Literal["good", "doubtful"]) -> str:
    """Return what to call a result of which so many frames have a place: never better than it calls itself."""
    if placed < _LEAST_PLACED:
        return "bad"
    return quality if placed >= _MOST_PLACED else "doubtful"


def _channels_last(picture: NDArray[Any]) -> NDArray[Any]:
    return np.moveaxis(picture, 0, -1) if picture.ndim == 3 else picture


def _check_mosaic(settings: Settings) -> None:
    _check_names(settings, "mosaic", ("motion",))


def _check_video(settings: Settings) -> None:
    _check_names(settings, "video", ("motion", "window", "stabilised", "regions", "mp4", "scale_bar"))
    window = settings.get("window")
    if window is not None and (not isinstance(window, int) or isinstance(window, bool) or window < 1):
        raise SettingsError(f"window must be a number of frames, at least 1; got {window!r}")
    for name in ("stabilised", "mp4", "scale_bar"):
        if not isinstance(settings.get(name, False), bool):
            raise SettingsError(f"{name} must be true or false; got {settings[name]!r}")
    if settings.get("mp4", False):
        import_av("writing films", OutputError)
    elif settings.get("scale_bar", False):
        raise SettingsError("scale_bar is drawn into a film, and none is asked for; set mp4 as well")
    regions = settings.get("regions", ".")
    if not isinstance(regions, str) or not Path(regions).exists():
        raise SettingsError(f"regions must be a label image, or a folder of one for each recording; got {regions!r}")


def _check_names(settings: Settings, task: str, known: tuple[str, ...]) -> None:
    for name in settings:
        if name not in known:
            raise SettingsError(f"{name} is no setting of a {task}; known ones are {', '.join(('bundle', *known))}")
    if settings.get("motion", "auto") not in FREEDOM:
        raise SettingsError(f"motion must be one of {', '.join(FREEDOM)}; got {settings['motion']!r}")


def _check_burst(settings: Settings) -> None:
    frames = settings.get("frames", 20)
    if not isinstance(frames, int) or frames < 2:
        raise SettingsError(f"frames must be a number of frames, at least 2; got {frames!r}")
    choose(**{name: value for name, value in settings.items() if name != "frames"})


# What can be done with every recording: what does it, and what refuses settings beforehand.
TASKS: dict[str, tuple[Callable[..., Generator[Doing, None, Made]], Callable[[Settings], None]]] = {
    "mosaic": (_mosaic, _check_mosaic),
    "video": (_video, _check_video),
    "burst": (_burst, _check_burst),
}
