"""Figures, by matplotlib, from the rows and images of a results folder."""

from collections.abc import Iterator
from io import BytesIO

import matplotlib as mpl
import numpy as np
from matplotlib import pyplot as plt
from matplotlib.figure import Figure

from benchmarks.methods import METHODS
from benchmarks.results import ABLATION, CONDITIONS, REAL, SCENES, Results

DOTS_PER_INCH = 110
# One colour a method in all figures, after Okabe and Ito (2008), whose colours colour-blind readers can distinguish.
COLOURS = (
    "#999999",
    "#56B4E9",
    "#8FC7EA",
    "#CC79A7",
    "#E69F00",
    "#B97E00",
    "#F0E442",
    "#009E73",
    "#0072B2",
    "#D55E00",
    "#000000",
)


def drawn(results: Results) -> Iterator[tuple[str, Figure]]:
    """Yield all figures whose rows and images are there, by name."""
    mpl.use("Agg")
    for name, make in FIGURES.items():
        figure = make(results)
        if figure is not None:
            yield name, figure
            plt.close(figure)


def as_png(figure: Figure) -> bytes:
    """Return a figure as the content of a file."""
    file = BytesIO()
    figure.savefig(file, format="png", dpi=DOTS_PER_INCH, bbox_inches="tight")
    return file.getvalue()


def colour(method: str) -> str:
    """Return a method's colour."""
    return COLOURS[list(METHODS).index(method)]


def _scenes(results: Results) -> Figure | None:
    rows = {(row["case"], row["method"]): row for row in results.rows(SCENES)}
    cases = list(dict.fromkeys(case for case, _ in rows))
    columns = [name for name in ("truth", *METHODS) if any(method == name for _, method in rows)]
    images = {key: results.image(SCENES, *key) for key, row in rows.items() if "missing" not in row}
    if not cases or any(image is None for image in images.values()):
        return None
    figure, axes = plt.subplots(
        len(cases), len(columns), figsize=(1.9 * len(columns), 2.2 * len(cases)), squeeze=False, layout="constrained"
    )
    for number, (across, case) in enumerate(zip(axes, cases, strict=True)):
        for axis, method in zip(across, columns, strict=True):
            image = images.get((case, method))
            axis.set_xticks([])
            axis.set_yticks([])
            if image is not None:
                axis.imshow(image, cmap="gray", vmin=0, vmax=255)
            row = rows.get((case, method), {})
            axis.set_xlabel(f"{row['psnr']:.1f} dB" if "psnr" in row else row.get("missing", "")[:14], fontsize=8)
            if number == 0:
                axis.set_title(
                    METHODS[method].label.replace(", ", "\n") if method in METHODS else "truth", fontsize=7.5
                )
        across[0].set_ylabel(case, fontsize=9)
    return figure


def _convergence(results: Results) -> Figure | None:
    rows = [row for row in results.rows(ABLATION) if row["curve"]]
    if not rows:
        return None
    figure, axes = plt.subplots(1, 2, figsize=(11, 5.5), sharey=True, layout="constrained")
    for axis, is_motion in zip(axes, (True, False), strict=True):
        shown = [
            row
            for row in rows
            if (row["encoding"] in ("fourier", "spline") if is_motion else row["motion"] == "homography")
        ]
        names = list(dict.fromkeys(row["motion" if is_motion else "encoding"] for row in shown))
        for row in shown:
            name = row["motion" if is_motion else "encoding"]
            kind = "spline, " if is_motion and row["encoding"] == "spline" else ""
            label = f"{kind}{name}, {'with' if row['bundle_model'] else 'without'} bundle model"
            curve = np.array([*row["curve"], (row["seconds"], row["psnr"])])
            style = ":" if row["encoding"] == "spline" else "-" if row["bundle_model"] else "--"
            axis.plot(*curve.T, style, color=f"C{names.index(name)}", label=label, linewidth=1.4)
        axis.set(xlabel="seconds", xscale="log", title="motion" if is_motion else "encoding")
        axis.grid(alpha=0.3)
        if shown:
            axis.legend(fontsize=7, ncols=2, loc="upper center", bbox_to_anchor=(0.5, -0.12))
    axes[0].set_ylabel("PSNR, dB")
    return figure


def _conditions(results: Results) -> Figure | None:
    rows = [row for row in results.rows(CONDITIONS) if "psnr" in row]
    if not rows:
        return None
    cases = list(dict.fromkeys(row["case"] for row in rows))
    figure, axis = plt.subplots(figsize=(8, 0.28 * len(cases) + 1.2), layout="constrained")
    for method in METHODS:
        own = [row for row in rows if row["method"] == method]
        if own:
            places = [cases.index(row["case"]) for row in own]
            marker = "D" if method == "default" else "|" if method == "oracle" else "o"
            axis.plot(
                [row["psnr"] for row in own], places, marker, color=colour(method), label=METHODS[method].label,
                markersize=11 if marker == "|" else 6, markeredgewidth=2 if marker == "|" else 0.5,
            )  # fmt: skip
    axis.set_yticks(range(len(cases)), cases, fontsize=8)
    axis.invert_yaxis()
    axis.set_xlabel("PSNR, dB")
    axis.grid(alpha=0.3)
    axis.legend(fontsize=7, loc="center left", bbox_to_anchor=(1, 0.5))
    return figure


def _real(results: Results) -> Figure | None:
    found = {row["method"]: row for row in results.rows(REAL) if "elements" in row}
    names = [name for name in METHODS if name in found]
    images = [image for name in names if (image := results.image(REAL, "chart", name)) is not None]
    if not names or len(images) < len(names):
        return None
    figure, axes = plt.subplots(1, len(names), figsize=(3.1 * len(names), 3.9), squeeze=False, layout="constrained")
    for axis, name, image in zip(axes[0], names, images, strict=True):
        axis.imshow(image[380:860, 90:390], cmap="gray", vmin=0, vmax=255)  # group 7
        axis.set_title(
            f"{METHODS[name].label}\nM {found[name]['modulation']:.2f}, ring {found[name]['ring_db']:.0f} dB",
            fontsize=8,
        )
        axis.axis("off")
    return figure


def _profiles(results: Results) -> Figure | None:
    found = {row["method"]: row for row in results.rows(REAL) if "profiles" in row}
    names = [name for name in METHODS if name in found]
    if not names:
        return None
    elements = list(found[names[0]]["profiles"])
    figure, axes = plt.subplots(1, len(elements), figsize=(11, 3), sharey=True, layout="constrained")
    for axis, element in zip(np.atleast_1d(axes), elements, strict=True):
        for name in names:
            axis.plot(*found[name]["profiles"][element], color=colour(name), label=METHODS[name].label, linewidth=1.4)
        axis.set(xlabel="pixels across the bars", title=element)
        axis.grid(alpha=0.3)
    axes[0].set_ylabel("light, chart's dark = 0, glass = 1")
    axes[-1].legend(fontsize=7)
    return figure


def _published_start(results: Results) -> Figure | None:
    curves = results.start_curves
    if not curves:
        return None
    figure, axes = plt.subplots(1, 2, figsize=(9, 3.4), layout="constrained")
    for name, curve in sorted(curves.items()):
        steps, decibels, similarity, _ = np.array(curve).T
        axes[0].plot(steps, decibels, label=name)
        axes[1].plot(steps, similarity, label=name)
    for axis, label in zip(axes, ("PSNR, dB", "SSIM"), strict=True):
        axis.set(xlabel="steps", ylabel=label)
        axis.grid(alpha=0.3)
    axes[1].legend(frameon=False, fontsize=8)
    return figure


FIGURES = {
    "scenes": _scenes,
    "convergence": _convergence,
    "conditions": _conditions,
    "real": _real,
    "profiles": _profiles,
    "published_start": _published_start,
}
