"""The three ways to reconstruct a burst, each with the settings that apply to it. Standard library only."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import ClassVar, Literal, get_args

from napari_fiberburst.errors import SettingsError
from napari_fiberburst.settings.choices import (
    ENCODINGS,
    MOTIONS,
    NETWORK_MOTIONS,
    PUBLISHED_MOTIONS,
    AutoMotion,
    Encoding,
    Flow,
    Fourier,
    Homography,
    HomographyNetwork,
    Motion,
    NetworkMotion,
    PublishedMotion,
    SplineMotion,
)
from napari_fiberburst.settings.parameter import check, parameter

_PUBLISHED_SIGMA = 5.0
_STEPS = (
    "Optimisation steps at most, rounds of registration for the spline; more fits closer, in the end noise too. None "
    "lets the burst choose; as published, 3000."
)
_RATE = "Step size of Adam; more is faster and less stable. None suits the encoding; as published, 1e-4."


# Without slots, because a class with slots cannot have two such bases.
@dataclass(frozen=True, kw_only=True)
class _Drawn:
    """What every method lets a user choose of its image."""

    upsample: float = parameter(1.0, "Image pixels to a frame pixel, along each axis.", above=0, most=16)


@dataclass(frozen=True, kw_only=True)
class _BehindBundle(_Drawn):
    """What a method with a model of the bundle lets a user choose of it."""

    samples: Literal["auto", "cores", "pixels"] = parameter(
        "auto",
        "What is taken as one sample behind the bundle: each core, each lit pixel, or, auto, what the burst itself "
        "shows.",
    )
    flatten: Literal["motion", "frame", "none"] = parameter(
        "motion",
        "Which slow changes of brightness over the frame are the illumination's: those that the object's motion tells "
        "from it, none where it tells nothing; all that the mean frame shows, for a strong vignette without motion; or "
        "none. A bundle that is known is taken as it is.",
    )
    canvas: Literal["frame", "union"] = parameter(
        "frame", "What the image covers: the first frame's field, or all that any frame saw."
    )
    fill: bool = parameter(False, "Fill in the image where no core has looked, instead of leaving it empty (NaN).")
    held_out: float = parameter(
        0.05, "Part of the samples that is left out of the fit and tells how well it predicts.", least=0, most=0.5
    )


@dataclass(frozen=True, kw_only=True)
class _SceneNetwork(_Drawn):
    """The size of the scene network, and how it is trained."""

    scene_layers: int = parameter(4, "Hidden layers of the scene network.", least=1, most=64)
    scene_width: int = parameter(
        256, "Units per hidden layer of the scene network; more holds more detail.", least=1, most=2**14
    )
    batch: int | None = parameter(
        None, "Samples per step; None takes an eighth of a frame's pixels, as published.", least=1
    )


@dataclass(frozen=True, kw_only=True)
class SplineMethod(_BehindBundle):
    """A linear spline instead of a network, solved rather than trained: the fastest, and here the sharpest.

    Attributes
    ----------
    motion : SplineMotion
        How the object moves between frames.

    Notes
    -----
    The other attributes are parameters; `napari_fiberburst.settings.parameter.parameters_of` lists them.
    """

    name: ClassVar[str] = "spline"
    motions: ClassVar[Mapping[str, type[Motion]]] = MOTIONS
    motion: SplineMotion = field(default_factory=AutoMotion)
    smoothness: float | None = parameter(
        None,
        "Weight of the smoothness prior; more is smoother and less noisy. None lets two halves of the burst choose.",
        above=0,
        most=1e6,
    )
    iterations: int | None = parameter(None, _STEPS, least=1)
    leave_out: tuple[int, ...] = parameter(
        (), "Numbers of frames that are registered like the others, and left out of the image."
    )

    def __post_init__(self) -> None:
        if isinstance(self.motion, Flow):
            raise SettingsError(
                f"motion {self.motion.name} needs a network encoding: {', '.join(ENCODINGS)}; not the spline"
            )
        _check_part("motion", self.motion, self.motions)
        check(self)


@dataclass(frozen=True, kw_only=True)
class NetworkMethod(_BehindBundle, _SceneNetwork):
    """A network of coordinates, trained on the samples of the calibrated and registered bundle.

    Attributes
    ----------
    motion : NetworkMotion
        How the object moves between frames.
    encoding : Encoding
        How coordinates are presented to the network.

    Notes
    -----
    The other attributes are parameters; `napari_fiberburst.settings.parameter.parameters_of` lists them.
    """

    name: ClassVar[str] = "network"
    motions: ClassVar[Mapping[str, type[Motion]]] = NETWORK_MOTIONS
    motion: NetworkMotion = field(default_factory=Homography)
    encoding: Encoding = field(default_factory=Fourier)
    iterations: int | None = parameter(None, _STEPS, least=1)
    learning_rate: float | None = parameter(None, _RATE, above=0, most=1e6)

    def __post_init__(self) -> None:
        _check_part("motion", self.motion, self.motions)
        _check_part("encoding", self.encoding, ENCODINGS)
        check(self)

    @property
    def alignment(self) -> SplineMethod:
        """The method that calibrates and registers the burst before the network is trained."""
        return SplineMethod(
            motion=Homography() if isinstance(self.motion, Flow) else self.motion,
            samples=self.samples,
            flatten=self.flatten,
            canvas=self.canvas,
            upsample=self.upsample,
            fill=self.fill,
            held_out=self.held_out,
        )


@dataclass(frozen=True, kw_only=True)
class PublishedMethod(_SceneNetwork):
    """The method of "Seeing through fibers" (2026): networks of the frames as they are, without a bundle model.

    Attributes
    ----------
    motion : PublishedMotion
        How the object moves between frames.
    encoding : Encoding
        How coordinates are presented to the network. A frequency spread that is left open is 5, as published.

    Notes
    -----
    The other attributes are parameters; `napari_fiberburst.settings.parameter.parameters_of` lists them.
    """

    name: ClassVar[str] = "published"
    motions: ClassVar[Mapping[str, type[Motion]]] = PUBLISHED_MOTIONS
    motion: PublishedMotion = field(default_factory=HomographyNetwork)
    encoding: Encoding = field(default_factory=Fourier)
    iterations: int = parameter(3000, _STEPS, least=1)
    learning_rate: float = parameter(1e-4, _RATE, above=0, most=1e6)

    def __post_init__(self) -> None:
        _check_part("motion", self.motion, self.motions)
        _check_part("encoding", self.encoding, ENCODINGS)
        check(self)
        if isinstance(self.encoding, Fourier) and self.encoding.sigma is None:
            # Of a frozen dataclass, while it is made.
            object.__setattr__(self, "encoding", replace(self.encoding, sigma=_PUBLISHED_SIGMA))


TrainedMethod = NetworkMethod | PublishedMethod
Method = SplineMethod | NetworkMethod | PublishedMethod
METHODS: Mapping[str, type[Method]] = {method.name: method for method in get_args(Method)}


def _check_part(what: str, part: object, known: Mapping[str, type]) -> None:
    if type(part) not in known.values():
        names = ", ".join(choice.__name__ for choice in known.values())
        raise SettingsError(f"{what} must be one of {names}; got {part!r}")
