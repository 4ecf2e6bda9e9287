"""Fully connected networks with ReLU or sine activations, each seeded by a generator of its own."""

import math
from itertools import pairwise

import torch
from torch import Generator, Tensor, nn


def make_linear(inputs: int, outputs: int, bound: float, generator: Generator) -> nn.Linear:
    """Return a layer with weights uniform in +- bound and biases uniform in +- 1/sqrt(inputs), as torch has it."""
    # torch's own start would draw from its global generator.
    device = torch.get_default_device()  # meta, where only the sizes are asked for
    layer: nn.Linear = nn.utils.skip_init(nn.Linear, inputs, outputs, device=device)  # type: ignore[no-untyped-call]
    with torch.no_grad():
        layer.weight.uniform_(-bound, bound, generator=generator)
        layer.bias.uniform_(-1 / math.sqrt(inputs), 1 / math.sqrt(inputs), generator=generator)
    return layer


def make_mlp(widths: list[int], generator: Generator) -> nn.Sequential:
    """Return a ReLU network with a linear output, started as torch starts it; `widths` names all layers."""
    layers: list[nn.Module] = []
    for inputs, outputs in pairwise(widths):
        layers += [make_linear(inputs, outputs, 1 / math.sqrt(inputs), generator), nn.ReLU()]
    return nn.Sequential(*layers[:-1])


def make_xavier_mlp(widths: list[int], generator: Generator) -> nn.Sequential:
    """Return a ReLU network with a linear output, started as published.

    Weights are uniform with the variance 2 / (inputs + outputs), biases 0 (Glorot and Bengio, 2010).
    """
    network = make_mlp(widths, generator)
    with torch.no_grad():
        for layer in network:
            if isinstance(layer, nn.Linear):
                bound = math.sqrt(6 / (layer.in_features + layer.out_features))
                layer.weight.uniform_(-bound, bound, generator=generator)
                layer.bias.zero_()
    return network


class Sine(nn.Module):
    """sin(omega_0 x)."""

    def __init__(self, omega_0: float) -> None:
        super().__init__()
        self.omega_0 = omega_0

    def forward(self, values: Tensor) -> Tensor:
        """Return the sine, of the same shape."""
        return torch.sin(self.omega_0 * values)


def make_siren(widths: list[int], omega_0: float, generator: Generator) -> nn.Sequential:
    """Return a sine network with a linear output, initialised as in Sitzmann et al. (2020), section 3.2."""
    layers: list[nn.Module] = []
    for inputs, outputs in pairwise(widths):
        bound = math.sqrt(6 / inputs) / omega_0 if layers else 1 / inputs
        layers += [make_linear(inputs, outputs, bound, generator), Sine(omega_0)]
    return nn.Sequential(*layers[:-1])


def output_of(network: nn.Sequential) -> nn.Linear:
    """Return the last layer of a network."""
    output = network[-1]
    assert isinstance(output, nn.Linear)
    return output


def zero_output(network: nn.Sequential) -> None:
    """Make a network return 0 whatever comes in, by its last layer alone, so that it can still learn."""
    output = output_of(network)
    nn.init.zeros_(output.weight)
    nn.init.zeros_(output.bias)
