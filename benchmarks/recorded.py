"""Table 6: what the faults of recorded bursts cost, one by one and all together.

Every burst has the scene, motion and bundle of a clean one, on which the default is measured too, so that a line says
what its fault costs; and the oracle, which is told everything but the scene, says what of that nobody could get back.
Only what is visible of frame 0 counts, in the clean burst as well: not what lies outside a round field or under a
burned-in mark. A method that refuses a burst has its reason in its row.
"""

from collections.abc import Sequence
from dataclasses import asdict, replace
from functools import lru_cache

from benchmarks.cases import Case
from benchmarks.compare import in_words, score
from benchmarks.methods import METHODS, Effort, Outcome
from benchmarks.results import RECORDED, Recorder
from benchmarks.rows import Row
from napari_fiberburst.errors import FiberBurstError

SHOWN = ("default", "oracle", "gaussian", "pyfibrebundle", "pyfibrebundle-sr")
# The default on the same burst without its faults.
CLEAN = "clean"


def measure_recorded(recorder: Recorder, cases: Sequence[Case], methods: Sequence[str], effort: Effort) -> None:
    """Fill the table with those of the methods that it shows."""
    names = [name for name in SHOWN if name in methods]
    for case in cases:
        print(case, flush=True)
        recipe = {"burst": asdict(case)}
        for name in [*names, CLEAN] if "default" in names else names:
            parts = {part: getattr(effort, part) for part in METHODS.get(name, METHODS["default"]).depends_on}
            row = recorder.row(RECORDED, case.name, name, lambda: measure(case, name, effort), recipe | parts)  # noqa: B023
            print(f"  {METHODS[name].label if name in METHODS else name:34} {in_words(row)}", flush=True)


def measure(case: Case, name: str, effort: Effort) -> Row:
    """Return one row."""
    try:
        if name == CLEAN:
            outcome = _clean(replace(case, name=CLEAN, faults={}), effort)
        else:
            outcome = METHODS[name].run(case, case.make(), effort)
    except FiberBurstError as error:
        return {"missing": str(error)}
    return score(outcome, case.make())


@lru_cache(maxsize=1)
def _clean(case: Case, effort: Effort) -> Outcome:
    """Return what the default makes of a burst; the last one is kept, because many cases share it."""
    return METHODS["default"].run(case, case.make(), effort)
