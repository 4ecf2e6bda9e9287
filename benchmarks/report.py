"""Tables in Markdown, from the rows of a results folder."""

from collections.abc import Iterable, Sequence
from pathlib import Path
from statistics import mean

from benchmarks import figures
from benchmarks.methods import METHODS
from benchmarks.recorded import CLEAN, SHOWN
from benchmarks.results import ABLATION, CONDITIONS, COST, REAL, RECORDED, SCENES, Results
from benchmarks.rows import Row

ABSENT = "-"  # not measured
DECIBELS = (20, 22, 25, 30, 35, 40)


def write(results: Results) -> Path:
    """Write `tables.md` and `figures/` into the results folder, from all rows that are there."""
    for name, figure in figures.drawn(results):
        path = results.folder / "figures" / f"{name}.png"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(figures.as_png(figure))
    path = results.folder / "tables.md"
    path.write_text(in_markdown(results), encoding="utf-8")
    return path


def in_markdown(results: Results) -> str:
    """Return all tables whose rows are there, with links to ``figures/NAME.png``."""
    parts = _about(results)
    for build in (_scenes, _ablation, _conditions, _real, _costs, _recorded, _start):
        parts += build(results)
    return "\n\n".join(parts) + "\n"


def table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a table in Markdown."""
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def _about(results: Results) -> list[str]:
    about = results.about
    if not about:
        return []
    sentences = [
        f"Measured on {_machine(about)} ({about['mode']} run).",
        "The date of each table is UTC; a plus after its commit: with changes not yet committed.",
    ]
    for one in about.get("earlier", []):
        sentences.append(f"Rows before {one['until'][:16]}: {_machine(one)}, {one['torch_threads']} threads.")
    return [" ".join(sentences)]


def _machine(about: Row) -> str:
    versions = ", ".join(f"{name} {number}" for name, number in about["versions"].items() if number)
    machine = f"{about['processor']}, {about['cores']} cores, {about['memory_gib']} GiB, {about['gpu'] or 'no GPU'}"
    return f"{about['system']}, {machine}; Python {about['python']}, {versions}"


def _measured(rows: Sequence[Row]) -> str:
    dates = sorted(row["date"] for row in rows)
    first, last = dates[0][:16], dates[-1][:16]
    commits = ", ".join(sorted({str(row["commit"]) for row in rows if row["commit"]})) or "unknown"
    return f"Measured {first if first == last else f'{first} to {last}'}, commit {commits}."


def _scenes(results: Results) -> list[str]:
    rows = [row for row in results.rows(SCENES) if row["method"] != "truth"]
    if not rows:
        return []
    parts = ["### Table 1. Five scenes", _measured(rows)]
    for case in _in_order(rows, "case"):
        own = {row["method"]: row for row in rows if row["case"] == case}
        burst = next(iter(own.values()))["burst"]
        parts.append(
            f"**{case}** ({burst['scene']}, {burst['physics']} bundle, {burst['frames']} x {burst['side']} x "
            f"{burst['side']}, pitch {burst['pitch']:g}, {burst['side'] / burst['pitch']:.0f} cores across, "
            f"seed {burst['seed']})"
        )
        header = ["", "told", "PSNR dB / SSIM", "as given", "motion off by", "time", "compression"]
        lines = [[METHODS[name].label, METHODS[name].given, *_scored(own[name])] for name in METHODS if name in own]
        parts.append(table(header, lines))
    return [*parts, "![Table 1 in images](figures/scenes.png)"]


def _scored(row: Row) -> list[str]:
    if "missing" in row:
        return [row["missing"], *[ABSENT] * 4]
    squeezed = row["compression"]
    return [
        f"{row['psnr']:.2f} / {row['ssim']:.2f}",
        f"{row['psnr_as_given']:.2f} / {row['ssim_as_given']:.2f}",
        ABSENT if row.get("motion_error") is None else f"{row['motion_error']:.3f} px",
        _time(row["seconds"]),
        ABSENT if squeezed is None else f"{100 * squeezed:.1f} %",
    ]


def _ablation(results: Results) -> list[str]:
    rows = results.rows(ABLATION)
    if not rows:
        return []
    found = {(row["motion"], row["encoding"], row["bundle_model"]): row for row in rows}
    pairs = sorted({(motion, encoding) for motion, encoding, _ in found}, key=lambda pair: (pair[1] == "spline", pair))

    def cell(row: Row | None) -> str:
        if row is None:
            return ABSENT
        error = row.get("motion_error")
        moved = "" if error is None else f", {error:.2f} px"
        return f"{row['psnr']:.2f} / {row['ssim']:.2f}{moved}, {_time(row['seconds'])}"

    lines = [
        [motion, encoding, *(cell(found.get((motion, encoding, model))) for model in (False, True))]
        for motion, encoding in pairs
    ]
    header = ["motion", "encoding", "without bundle model", "with bundle model"]
    burst = rows[0]["burst"]
    return [
        "### Table 2. Motion and encoding",
        f"{burst['scene']}, {burst['physics']} bundle, {burst['frames']} x {burst['side']} x {burst['side']}, pitch "
        f"{burst['pitch']:g}. PSNR dB / SSIM, motion off by (after the fit; a flow is no homography), time. "
        + _measured(rows),
        table(header, lines),
        "![Convergence](figures/convergence.png)",
    ]


def _conditions(results: Results) -> list[str]:
    rows = results.rows(CONDITIONS)
    if not rows:
        return []
    found = {(row["case"], row["method"]): row for row in rows}
    names = [name for name in METHODS if any(method == name for _, method in found)]

    def cell(case: str, name: str) -> str:
        row = found.get((case, name))
        return ABSENT if row is None or "missing" in row else f"{row['psnr']:.1f} / {row['ssim']:.2f}"

    lines = []
    for case in _in_order(rows, "case"):
        own = found.get((case, "default"), {})
        error, used = own.get("motion_error"), own.get("frames_used")
        moved = ABSENT if error is None else f"{error:.2f} px, {used} frames"
        lines.append([case, *(cell(case, name) for name in names), moved])
    burst = next((row["burst"] for row in rows if row["case"] == "as it is"), rows[0]["burst"])
    return [
        "### Table 3. Conditions",
        f"As it is: {burst['scene']}, {burst['physics']} bundle, {burst['frames']} x {burst['side']} x "
        f"{burst['side']}, pitch {burst['pitch']:g}, 10,000 electrons, jitter 0.09. Each line changes one thing. "
        "PSNR dB / SSIM, and how far our motion is off, with the frames it uses. " + _measured(rows),
        table(["", *(METHODS[name].label for name in names), "our motion"], lines),
        "![Conditions](figures/conditions.png)",
    ]


def _real(results: Results) -> list[str]:
    found = {row["method"]: row for row in results.rows(REAL)}
    if not found:
        return []
    lines = []
    for name, method in METHODS.items():
        row = found.get(name)
        if row is None:
            continue
        if "missing" in row:
            lines.append([method.label, row["missing"], *[ABSENT] * 4])
            continue
        lines.append([
            method.label, f"{row['modulation']:.2f}", row["finest"], f"{row['ring_db']:.1f} dB", f"{row['nrmse']:.3f}",
            _time(row["seconds"]),
        ])  # fmt: skip
    measured = {name: found[name] for name in METHODS if "elements" in found.get(name, {})}
    each = [
        [f"G{group}E{element}", f"{period:.1f} px", *(_modulations(row, group, element) for row in measured.values())]
        for group, element, period in sorted({
            (item["group"], item["element"], item["period"]) for row in measured.values() for item in row["elements"]
        })
    ]  # fmt: skip
    return [
        "### Table 4. The real burst",
        "12 frames of 960 x 1280. M: mean modulation of the bars of group 7. Ring: the honeycomb that is left, against "
        "the raw frame. Prediction: error of the cores of frames 4, 7 and 11, each left out in turn, in standard "
        "deviations. PyFibreBundle is given the background image; ours is given nothing. "
        + _measured(list(found.values())),
        table(["", "M, group 7", "finest element", "ring", "prediction", "time"], lines),
        "Modulation of horizontal / vertical bars, a star where resolved:",
        table(["element", "period", *(METHODS[name].label for name in measured)], each),
        "![The real burst](figures/real.png)",
        "![Line profiles](figures/profiles.png)",
    ]


def _modulations(row: Row, group: int, element: int) -> str:
    own = {item["bars"]: item for item in row["elements"] if (item["group"], item["element"]) == (group, element)}
    return " / ".join(f"{own[bars]['modulation']:.2f}{'*' if own[bars]['resolved'] else ''}" for bars in "HV")


def _costs(results: Results) -> list[str]:
    rows = results.rows(COST)
    if not rows:
        return []
    own = sorted((row for row in rows if row["method"] == "default"), key=lambda row: row["seconds"])
    lines = [
        [row["case"], _time(row["first_preview"]), _time(row["seconds"]), f"{row['peak_mib']:.0f} MiB"] for row in own
    ]
    published = [row for row in rows if row["method"] == "paper"]
    lines += [
        [f"published method, {row['case']}", ABSENT, _time(row["seconds"]) + ", its 3000 steps", ABSENT]
        for row in published
    ]
    parts = [
        "### Table 5. Time and memory",
        _measured(rows),
        table(["frames x H x W x C", "first preview", "finished", "peak memory"], lines),
    ]
    for row in rows:
        if row["method"] == "stages":
            stages = ", ".join(f"{name} {seconds:.1f} s" for name, seconds in row["stages"].items())
            parts.append(f"Where the default's time goes ({row['case']}): {stages}.")
    return [*parts, *_time_to_quality(results)]


def _recorded(results: Results) -> list[str]:
    rows = results.rows(RECORDED)
    if not rows:
        return []
    found = {(row["case"], row["method"]): row for row in rows}
    labels = {"default": METHODS["default"].label, CLEAN: "the same without the fault"}
    labels |= {name: METHODS[name].label for name in SHOWN if name not in labels}
    names = [name for name in labels if any(method == name for _, method in found)]

    def cell(case: str, name: str) -> str:
        row = found.get((case, name))
        return ABSENT if row is None or "missing" in row else f"{row['psnr']:.1f} / {row['ssim']:.2f}"

    lines = []
    for case in _in_order(rows, "case"):
        own = found.get((case, "default"), {})
        error, used = own.get("motion_error"), own.get("frames_used")
        moved = ABSENT if error is None else f"{error:.2f} px, {used} frames"
        lines.append([case, *(cell(case, name) for name in names), own.get("quality") or ABSENT, moved])
    burst = rows[0]["burst"]
    return [
        "### Table 6. As recorded",
        f"Faults of recorded bursts, one by one at three strengths, and a mild one of each. {burst['physics']} bundle, "
        f"{burst['frames']} x {burst['side']} x {burst['side']}, pitch {burst['pitch']:g}. PSNR dB / SSIM of what is "
        "visible of frame 0, our verdict, and how far our homographies are off, with the frames used; a deformation is "
        "not in them. The oracle is our solver, told all but the scene: what it loses, the fault has taken away. "
        + _measured(rows),
        table(["", *(labels[name] for name in names), "our verdict", "our motion"], lines),
    ]


def _start(results: Results) -> list[str]:
    """Return how the published method ends from each start."""
    curves = results.start_curves
    if not curves:
        return []
    lines = []
    for name, curve in sorted(curves.items()):
        best, last = max(curve, key=lambda point: point[1]), curve[-1]
        reached = [
            f"{decibels:.1f} / {similarity:.2f} at step {step}" for step, decibels, similarity, _ in (best, last)
        ]
        lines.append([name, *reached, f"{last[3]:.2f} px"])
    return [
        "### The start of the published method",
        "PSNR dB / SSIM of frame 0 on the way, on one burst with everything else as published: see "
        "`benchmarks/published_start.py`.",
        table(["", "best", "at the end", "motion off by"], lines),
        "![The start of the published method](figures/published_start.png)",
    ]


def _time_to_quality(results: Results) -> list[str]:
    """Return how long each method takes to each quality, on average over the scenes where it comes so far."""
    rows = [row for row in results.rows(SCENES) if "psnr" in row and row["method"] != "oracle"]
    if not rows:
        return []
    cases = _in_order(rows, "case")
    lines = []
    for name in [name for name in METHODS if any(row["method"] == name for row in rows)]:
        own = [row for row in rows if row["method"] == name]
        lines.append([METHODS[name].label, *(_reached(own, decibels, len(cases)) for decibels in DECIBELS)])
    return [
        "Time to each PSNR on the bursts of Table 1: the mean over the scenes where a method comes so far, and how "
        "many they are. Methods without previews are there when they are done.",
        table(["", *(f"{decibels} dB" for decibels in DECIBELS)], lines),
    ]


def _reached(rows: Sequence[Row], decibels: float, count: int) -> str:
    times = [seconds for row in rows if (seconds := seconds_to(row, decibels)) is not None]
    return f"{_time(mean(times))} ({len(times)} of {count})" if times else ABSENT


def seconds_to(row: Row, decibels: float) -> float | None:
    """Return from when on a method showed images of at least this PSNR; None where its last one is not."""
    found = None
    for seconds, psnr in reversed([*row["curve"], (row["seconds"], row["psnr"])]):
        if psnr < decibels:
            break
        found = seconds
    return found


def _in_order(rows: Sequence[Row], column: str) -> list[str]:
    """Return a column's values in the order of the rows."""
    return list(dict.fromkeys(row[column] for row in rows))


def _time(seconds: float) -> str:
    if seconds < 0.05:
        return "0 s"
    return f"{seconds:.1f} s" if seconds < 100 else f"{seconds / 60:.1f} min"
