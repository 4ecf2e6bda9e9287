"""The scene field f: coordinates to intensities in [-1, 1]."""

from typing import assert_never

from torch import Generator, Tensor, nn

from napari_fiberburst import settings
from napari_fiberburst.networks.encodings import Coordinates, HashGrid, Octaves, RandomFourier
from napari_fiberburst.networks.layers import make_mlp, make_siren, make_xavier_mlp

PUBLISHED_SIGMA = 5.0


class SceneField(nn.Module):
    """f(gamma(p)): an encoding, then a network.

    Parameters
    ----------
    encoding : Module
        Coordinates (N, D) to features.
    network : Module
        Features to (N, C) intensities.
    """

    def __init__(self, encoding: nn.Module, network: nn.Module) -> None:
        super().__init__()
        self.encoding = encoding
        self.network = network

    def forward(self, points: Tensor) -> Tensor:
        """Return intensities (N, C) at scene points (N, D), in unit coordinates."""
        intensities: Tensor = self.network(self.encoding(points))
        return intensities

    @property
    def has_sigma(self) -> bool:
        """Whether the encoding has a frequency spread that `set_sigma` can change."""
        return isinstance(self.encoding, RandomFourier)

    def set_sigma(self, sigma: float) -> None:
        """Change the frequency spread of the Fourier encoding."""
        assert isinstance(self.encoding, RandomFourier)
        self.encoding.sigma.fill_(sigma)


def make_scene(chosen: settings.Settings, dimensions: int, channels: int, generator: Generator) -> SceneField:
    """Build the scene field that the settings ask for.

    Parameters
    ----------
    chosen : Settings
        Its encoding and the size of its scene network.
    dimensions : int
        2 for (x, y), 3 for (x, y, t).
    channels : int
        Intensities per point.
    generator : torch.Generator
        Source of all random numbers, on the CPU.
    """
    encoding: nn.Module
    match chosen.encoding:
        case settings.NoEncoding() | settings.Siren():
            encoding = Coordinates(dimensions)
        case settings.NeRF(highest_octave=highest_octave):
            encoding = Octaves(dimensions, highest_octave)
        case settings.Fourier(features=features, sigma=sigma):
            encoding = RandomFourier(dimensions, features, PUBLISHED_SIGMA if sigma is None else sigma, generator)
        case settings.Hash() as choice:
            encoding = HashGrid(dimensions, choice, generator)
        case settings.Spline():
            raise ValueError("a spline is solved, not trained: it is no network")
        case _:
            assert_never(chosen.encoding)
    widths = [encoding.width, *[chosen.scene_width] * chosen.scene_layers, channels]
    if isinstance(chosen.encoding, settings.Siren):
        return SceneField(encoding, make_siren(widths, chosen.encoding.omega_0, generator))
    # Behind a bundle torch's own start came out 0.3 to 1.4 dB better (Fourier, hash, NeRF; 250 steps).
    make = make_xavier_mlp if chosen.is_published else make_mlp
    return SceneField(encoding, make(widths, generator))
