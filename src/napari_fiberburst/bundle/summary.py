"""What a bundle has, in words: for the command line and for the dock."""

import numpy as np

from napari_fiberburst.bundle.bundle import Bundle

_PLACES = {"cores": "cores", "unresolved": "blocks of pixels, because cores cannot be told apart"}


def summary(bundle: Bundle) -> tuple[tuple[str, str], ...]:
    """Return what is known of a bundle, as pairs of a name and what it is."""
    height, width = bundle.shape
    told = bundle.provenance
    gains = "unknown" if not bundle.gains_known else f"known by {np.median(bundle.gain_weights):.2g} bright exposures"
    return (
        ("height x width", f"{height} x {width}"),
        (_PLACES.get(bundle.pattern, "blocks of pixels"), str(len(bundle.centres))),
        ("pitch", f"{bundle.pitch:.2f} pixels"),
        ("footprint", f"{bundle.radius:.2f} pixels radius"),
        ("field", f"{bundle.outline.mean():.0%} of the frame"),
        ("dead", str(len(bundle.dead))),
        ("saturated", str(int(bundle.saturated.sum()))),
        ("black", f"{bundle.black:g}"),
        ("offsets", f"up to {bundle.offsets.max():.3g}" if bundle.offsets.any() else "none"),
        ("channels", str(bundle.gains.shape[1]) if bundle.gains.shape[1] > 1 else "alike"),
        ("gains", f"{gains}, {told.get('bursts', 0)} bursts"),
        ("from", ", ".join([told.get("source", "unknown"), *told.get("files", [])])),
        ("on", f"{told.get('date', 'unknown')}, version {told.get('version', 'unknown')}"),
    )
