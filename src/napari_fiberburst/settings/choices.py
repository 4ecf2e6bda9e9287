"""What a method is made of: how a network is shown coordinates, and how the object moves. Standard library only."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar, get_args

from napari_fiberburst.settings.parameter import check, parameter


@dataclass(frozen=True, slots=True, kw_only=True)
class NoEncoding:
    """The coordinates as they are: a smooth image without fine detail."""

    name: ClassVar[str] = "none"


@dataclass(frozen=True, slots=True, kw_only=True)
class NeRF:
    """Sines and cosines at octaves (Mildenhall et al., 2020)."""

    name: ClassVar[str] = "nerf"
    highest_octave: int = parameter(
        15, "L of the octaves 2^0 to 2^L; more resolve finer detail, noise and honeycomb.", least=0, most=24
    )

    def __post_init__(self) -> None:
        check(self)


@dataclass(frozen=True, slots=True, kw_only=True)
class Fourier:
    """Random Fourier features (Tancik et al., 2020)."""

    name: ClassVar[str] = "fourier"
    features: int = parameter(
        256, "Random frequencies; more resolve detail more evenly, at more cost.", least=1, most=2**16
    )
    sigma: float | None = parameter(
        None,
        "Frequency spread, cycles per half frame; more resolves finer detail, and noise. None follows the core pitch; "
        "without a bundle model it is 5, as published, and more resolves the honeycomb in the end.",
        above=0,
        most=1e6,
    )

    def __post_init__(self) -> None:
        check(self)


@dataclass(frozen=True, slots=True, kw_only=True)
class Hash:
    """Multi-resolution hash grid (Müller et al., 2022)."""

    name: ClassVar[str] = "hash"
    levels: int = parameter(12, "Grid levels; more resolve finer detail.", least=1, most=24)
    level_features: int = parameter(
        2, "Learned values per grid point; more can hold more, at more cost.", least=1, most=64
    )
    table_bits: int = parameter(16, "Binary log of the table length; more means fewer collisions.", least=4, most=24)
    base_resolution: int = parameter(4, "Cells across the frame at the coarsest level.", least=1, most=4096)
    growth: float = parameter(
        1.61, "Ratio of cells from one level to the next; more reaches finer cells.", above=1, most=2
    )

    def __post_init__(self) -> None:
        check(self)


@dataclass(frozen=True, slots=True, kw_only=True)
class Siren:
    """Sine activations instead of an encoding (Sitzmann et al., 2020)."""

    name: ClassVar[str] = "siren"
    omega_0: float = parameter(
        30.0, "Frequency of the sine activations; more resolves finer detail.", above=0, most=1e4
    )

    def __post_init__(self) -> None:
        check(self)


@dataclass(frozen=True, slots=True, kw_only=True)
class NoMotion:
    """No motion: the object stands still; without a bundle model, a network memorises f(x, y, t)."""

    name: ClassVar[str] = "none"
    dof: ClassVar[int] = 0
    bends: ClassVar[bool] = False


@dataclass(frozen=True, slots=True, kw_only=True)
class Translation:
    """One shift per frame."""

    name: ClassVar[str] = "translation"
    dof: ClassVar[int] = 2
    bends: ClassVar[bool] = False


@dataclass(frozen=True, slots=True, kw_only=True)
class Similarity:
    """One shift, rotation and scale per frame."""

    name: ClassVar[str] = "similarity"
    dof: ClassVar[int] = 4
    bends: ClassVar[bool] = False


@dataclass(frozen=True, slots=True, kw_only=True)
class Affine:
    """One affine transform per frame: shift, rotation, scale and shear."""

    name: ClassVar[str] = "affine"
    dof: ClassVar[int] = 6
    bends: ClassVar[bool] = False


@dataclass(frozen=True, slots=True, kw_only=True)
class Homography:
    """One homography per frame: a flat object, seen from anywhere."""

    name: ClassVar[str] = "homography"
    dof: ClassVar[int] = 8
    bends: ClassVar[bool] = False


@dataclass(frozen=True, slots=True, kw_only=True)
class Deformable:
    """One homography per frame, and a smooth displacement beyond it: tissue that bends."""

    name: ClassVar[str] = "deformable"
    dof: ClassVar[int] = 8
    bends: ClassVar[bool] = True


@dataclass(frozen=True, slots=True, kw_only=True)
class AutoMotion:
    """As much freedom as the burst asks for: translation, similarity, affine, homography, or deformable."""

    name: ClassVar[str] = "auto"
    dof: ClassVar[None] = None
    bends: ClassVar[None] = None


@dataclass(frozen=True, slots=True, kw_only=True)
class _MotionNetwork:
    # Behind a bundle the frames are registered by homographies before the network refines them.
    dof: ClassVar[int] = 8
    bends: ClassVar[bool] = False
    motion_layers: int = parameter(3, "Hidden layers of the motion network.", least=1, most=64)
    motion_width: int = parameter(256, "Units per hidden layer of the motion network.", least=1, most=2**14)

    def __post_init__(self) -> None:
        check(self)


@dataclass(frozen=True, slots=True, kw_only=True)
class HomographyNetwork(_MotionNetwork):
    """One 3x3 homography per frame, by a network of time, as published."""

    name: ClassVar[str] = "homography"


@dataclass(frozen=True, slots=True, kw_only=True)
class Flow(_MotionNetwork):
    """A displacement per pixel and frame, from a sine network: objects that deform."""

    name: ClassVar[str] = "flow"
    bends: ClassVar[bool] = True
    flow_omega_0: float = parameter(
        30.0, "Frequency of the motion network's sine activations; more bends the flow more.", above=0, most=1e4
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class FlowTV(Flow):
    """Optical flow with total variation: displacements that change little from pixel to pixel."""

    name: ClassVar[str] = "flow_tv"
    tv_weight: float = parameter(1.0, "Weight of the flow's total variation; more makes it smoother.", least=0)


Encoding = NoEncoding | NeRF | Fourier | Hash | Siren
# Behind a bundle model every frame has a transform of its own; as published, a network of time gives them all.
FrameMotion = NoMotion | Translation | Similarity | Affine | Homography
NetworkMotion = FrameMotion | Flow | FlowTV
SplineMotion = AutoMotion | FrameMotion | Deformable
PublishedMotion = NoMotion | HomographyNetwork | Flow | FlowTV
Motion = SplineMotion | Flow | FlowTV | HomographyNetwork

ENCODINGS: Mapping[str, type[Encoding]] = {choice.name: choice for choice in get_args(Encoding)}
MOTIONS: Mapping[str, type[Motion]] = {
    choice.name: choice for choice in get_args(Motion) if choice is not HomographyNetwork
}
NETWORK_MOTIONS: Mapping[str, type[Motion]] = {choice.name: choice for choice in get_args(NetworkMotion)}
PUBLISHED_MOTIONS: Mapping[str, type[Motion]] = {choice.name: choice for choice in get_args(PublishedMotion)}
