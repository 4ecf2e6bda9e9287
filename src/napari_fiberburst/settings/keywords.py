"""The keywords that `reconstruct`, the command line and forms take: every parameter there is, on one level."""

from napari_fiberburst.settings.choices import ENCODINGS, MOTIONS, HomographyNetwork
from napari_fiberburst.settings.methods import METHODS, NetworkMethod, PublishedMethod, SplineMethod
from napari_fiberburst.settings.parameter import Parameter, parameters_of

# What the keyword `encoding` takes by name: the spline is chosen in the networks' place.
ENCODING_NAMES = (SplineMethod.name, *ENCODINGS)
# The keyword `observation` tells a method's `samples`, or that there is no bundle model to take them with.
OBSERVATION = Parameter(
    name="observation",
    kind=str,
    default="auto",
    doc="What is taken as one sample behind the self-calibrated bundle: each core, each lit pixel, or, auto, what the "
    "burst itself shows; frames stands for the published method, which has no bundle model.",
    choices=("auto", "cores", "pixels", "frames"),
)
# Parameters that some methods have are told by what the user has chosen to come to those methods.
_METHODS_IN_WORDS = {
    (SplineMethod,): ("encoding", SplineMethod.name),
    (NetworkMethod, PublishedMethod): ("", "networks"),
    (SplineMethod, NetworkMethod): ("", "a bundle model"),
}


def keywords_of(owner: type) -> dict[str, Parameter]:
    """Return the parameters of a method, motion, encoding or of the settings by their keywords."""
    parameters = {name: parameter for name, parameter in parameters_of(owner).items() if name != "samples"}
    return {"observation": OBSERVATION, **parameters} if owner in METHODS.values() else parameters


def owners_of(name: str) -> list[tuple[str, str]]:
    """Return (part, choice) for each choice that the keyword applies to; none where it applies whatever is chosen.

    The part is "motion" or "encoding", or "" where the choice is a group of them.
    """
    choices: list[tuple[str, str, type]] = [("motion", known, motion) for known, motion in MOTIONS.items()]
    choices += [("motion", "homography as published", HomographyNetwork)]
    choices += [("encoding", known, encoding) for known, encoding in ENCODINGS.items()]
    owners = [(part, known) for part, known, owner in choices if name in keywords_of(owner)]
    methods = tuple(method for method in METHODS.values() if name in keywords_of(method))
    return [*owners, *([_METHODS_IN_WORDS[methods]] if methods in _METHODS_IN_WORDS else [])]
