"""The blind targets of the tracer, one row each, from records of sets (docs/trace-figures.md).

A share's interval is the exact one of Clopper and Pearson, 95 %. A target is met if the observed share meets it; the
interval says how sure that is.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.special import betaincinv

from trace_sets.log_kinds import LOG_KINDS
from trace_sets.sizing import STRONG, WEAK
from trace_sets.unopened import KINDS, ROBOT_CLEAN, ROBOT_KINDS, ROBOT_NAMED

Record = dict[str, Any]

RIGHT, NOT_WRONG = {"right"}, {"right", "tie", "none"}
SURE, GOOD_REVERSED = {"right", "tie"}, {"right", "tie", "honest"}
LARGE = 50_000
"""Steps of a long set."""
NOTHING = 1e-9
"""Of the nominal model's error: a reduction that is rounding."""
WHITE = {"clean", "clean_closed", "clean_poor", "long_clean"}
ROUGH = {"clean_coloured", "clean_outliers", "clean_student", "clean_quantised", "clean_jittered"}


@dataclass(frozen=True)
class Row:
    """what; k of n; the share (or figure) found, its interval, the target, and whether that is met (None: nothing to judge by)."""

    what: str
    n: int
    found: str
    interval: str
    target: str
    met: bool | None

    def text(self) -> str:
        """One line."""
        verdict = {True: "met", False: "NOT MET", None: "-"}[self.met]
        return f"{self.what:<66}{self.n:>6}  {self.found:>9}  {self.interval:<18}{self.target:>8}  {verdict}"


def clopper_pearson(k: int, n: int, level: float = 0.95) -> tuple[float, float]:
    """The exact interval of a share."""
    tail = 0.5 * (1.0 - level)
    low = 0.0 if k == 0 else float(betaincinv(k, n - k + 1, tail))
    high = 1.0 if k == n else float(betaincinv(k + 1, n - k, 1.0 - tail))
    return low, high


def _share(what: str, yes: Iterable[bool], target: float, *, at_most: bool = False, high: float | None = None) -> Row:
    flags = list(yes)
    n, k = len(flags), sum(flags)
    asked = f"{target:.0%}-{high:.0%}" if high is not None else f"{'<=' if at_most else '>='} {target:.0%}"
    if not n:
        return Row(what, 0, "-", "", asked, None)
    low, top = clopper_pearson(k, n)
    share = k / n
    met = share <= target if at_most else share >= target and (high is None or share <= high)
    return Row(what, n, f"{share:.1%}", f"[{low:.1%}, {top:.1%}]", asked, met)


def _figure(
    what: str, values: list[float], figure: Callable[[list[float]], float], target: float, *, at_most: bool = False, form: str = ".1%"
) -> Row:
    asked = f"{'<=' if at_most else '>='} {target:{'.0%' if form == '.1%' else 'g'}}"
    if not values:
        return Row(what, 0, "-", "", asked, None)
    found = figure(values)
    return Row(what, len(values), f"{found:{form}}", "", asked, found <= target if at_most else found >= target)


def reached(record: Record, kind: str = "noisy") -> float | None:
    """Share of the error reduction that was there to be reached; None where none was: on new inputs the missing effect may not act (a limit
    beyond its commands).
    """
    again = record.get("again")
    if not again:
        return None
    nominal, repaired, oracle = again[kind]
    there = nominal - oracle
    return float((nominal - repaired) / there) if there > NOTHING * nominal else None


def rows(records: list[Record]) -> list[Row]:
    """Every target."""
    done = [r for r in records if r["outcome"] not in {"refused", "crash"}]

    def of(*families: str) -> list[Record]:
        return [r for r in done if r["family"] in families]

    def words(given: Iterable[Record], *wanted: str) -> list[bool]:
        return [r["outcome"] in wanted for r in given]

    one = [r for r in of("one", "weak", "long") if r["ratio"] is not None]
    strong, weak = [r for r in one if r["ratio"] >= STRONG], [r for r in one if WEAK <= r["ratio"] < STRONG]
    outside, pairs = of("outside"), of("pair")
    told = [inside for r in [*one, *pairs] for _, inside in r["covered"]]
    share = [x for x in (reached(r) for r in [*strong, *pairs]) if x is not None]
    changed = [r for r in done if r.get("again") and r["verdict"] in {"traced", "ambiguous"}]
    worse, worse_of_library = (
        [r["again"]["noisy"][1] > 1.02 * r["again"]["noisy"][0] for r in some]
        for some in (changed, [r for r in changed if r["family"] not in {"outside", *KINDS, *ROBOT_KINDS}])
    )
    short = [r["cpu_s"] for r in done if 1000 <= r["n"] <= 1500]
    tiny = [r for r in records if r["family"] in {"tiny", "tiny_clean"} and r["outcome"] not in {"refused", "crash"}]
    lost = [
        r["outcome"] == "crash" or (r["outcome"] == "refused" and r["n"] >= 120)
        for r in records
        if r["family"] not in {"bad", "clean_poor", "unmeasured"}
    ]
    return [
        _share("false alarms, clean, white noise", words(of(*WHITE), "alarm"), 0.01, at_most=True),
        _share("  of these in closed loop", words(of("clean_closed"), "alarm"), 0.01, at_most=True),
        _share("false alarms, clean, coloured, heavy-tailed, quantised, jittered", words(of(*ROUGH), "alarm"), 0.05, at_most=True),
        _share("one effect that matters (>= 1.5): right name", words(strong, *RIGHT), 0.90),
        _share("one weak effect (1.1 to 1.5): right, honest tie or none", words(weak, *NOT_WRONG), 0.85),
        _share("one effect: wrong name", words(one, "wrong"), 0.03, at_most=True),
        _share("two effects: exact pair", words(pairs, "right"), 0.75),
        _share("known unnamed kinds: unflagged false name", words(outside, "false_name"), 0.10, at_most=True),
        _share("known unnamed kinds: right depends_on", [r["depends_right"] for r in outside], 0.70),
        replace(_share("  said that nothing is left, or noise", words(outside, "none"), 0.0), target="", met=None),
        *_unopened(done),
        *_log_kinds(done),
        _share("not separable by construction: tie reported", words(of("tie"), "tie"), 0.90),
        _figure("error reduction reached, median (matters, pairs)", share, lambda v: float(np.median(v)), 0.97),
        _figure("error reduction reached, 10th percentile", share, lambda v: float(np.quantile(v, 0.1)), 0.85),
        _share("95 % intervals that cover", told, 0.90, high=0.98),
        _share("repaired model worse than nominal", worse, 0.01, at_most=True),
        _share("  of these, where the library has the effect", worse_of_library, 0.01, at_most=True),
        _figure("CPU s, 1000 to 1500 steps, 90th percentile", short, lambda v: float(np.quantile(v, 0.9)), 2.0, at_most=True, form=".2f"),
        _figure("CPU s, 50 000 to 100 000 steps, most", [r["cpu_s"] for r in done if r["n"] >= LARGE], max, 60.0, at_most=True, form=".1f"),
        _share("sensor faults: found and placed, no name lent", words([r for r in of("fault") if not r["truth"]], "found"), 0.80),
        _share("  with an effect beside: its right name", words([r for r in of("fault") if r["truth"]], "right"), 0.80),
        _share("speeds not measured: right name", words(of("unmeasured"), "right"), 0.70),
        _share("20 to 120 steps: false alarm or wrong name", words(tiny, "alarm", "wrong"), 0.05, at_most=True),
        _share("bad input: refused in a line, or no name", words([r for r in records if r["family"] == "bad"], "honest"), 0.95),
        _share("crashed, or refused 120 steps or more", lost, 0.0, at_most=True),
    ]


def _log_kinds(done: list[Record]) -> list[Row]:
    """Recordings as logs of real robots are: for each family that was run its clean sets, its faults, and its effects."""
    found: list[Row] = []
    for family in (f for f in LOG_KINDS if any(r["family"] == f for r in done)):
        here = [r for r in done if r["family"] == family]
        clean = [r["outcome"] in {"alarm", "false_name"} for r in here if r["expect"] in {"clean", "unpromised"}]
        faults = [r["outcome"] == "found" for r in here if r["expect"] == "fault"]
        effects = [r for r in here if r["expect"] in {"one", "pair", "fault_effect"} and (r["ratio"] or 0.0) >= STRONG]
        reversed_ = [r["outcome"] in GOOD_REVERSED for r in here if r["expect"] == "reversed"]
        late = [r["delay_right"] for r in here if r.get("delay_right") is not None]
        found += [
            _share(f"{family}: false alarms, nothing missing", clean, 0.05, at_most=True),
            _share("  a fault: found and placed, no effect lent", faults, 0.80),
            _share("  delay of a sensor: within a fifth, or half a sample", late, 0.80),
            _share("  wrong sign: rejected, unexplained, or a gain below zero", reversed_, 0.95),
            _share("  an effect that matters: right, with its values, or an honest tie", [r["outcome"] in SURE for r in effects], 0.90),
            _share("  an effect: wrong name, or a value far off", [r["outcome"] in {"wrong", "off"} for r in effects], 0.03, at_most=True),
        ]
    return [row for row in found if row.n]


def _unopened(done: list[Record]) -> list[Row]:
    """Kinds and a robot that whoever changes the tracer has not seen."""

    def words(families: Iterable[str], *wanted: str) -> list[bool]:
        return [r["outcome"] in wanted for r in done if r["family"] in {*families}]

    def kinds(what: str, families: Iterable[str]) -> list[Row]:
        return [
            _share(f"{what}: unflagged false name", words(families, "false_name"), 0.10, at_most=True),
            _share(f"{what}: right depends_on", [r["depends_right"] for r in done if r["family"] in {*families}], 0.70),
            replace(_share("  said that nothing is left, or noise", words(families, "none"), 0.0), target="", met=None),
        ]

    return [
        *kinds("unopened kinds", KINDS),
        _share("unopened robot: false alarms, clean", words(ROBOT_CLEAN, "alarm"), 0.05, at_most=True),
        _share("unopened robot, one effect: right name", words(ROBOT_NAMED, *RIGHT), 0.90),
        _share("unopened robot, one effect: wrong name", words(ROBOT_NAMED, "wrong"), 0.03, at_most=True),
        *kinds("unopened robot, unopened kinds", ROBOT_KINDS),
    ]


def beside(records: list[Record]) -> list[Row]:
    """What PySINDy's STLSQ makes of the same sets; no targets. A term of the right kind is all that is asked of it."""
    told = [r for r in records if r.get("sindy")]

    def share(what: str, yes: Iterable[bool]) -> Row:
        return replace(_share(what, yes, 0.0), target="", met=None)

    one = [r for r in told if r["family"] in {"one", "weak"}]
    rows_of = [
        share("STLSQ: keeps a term on clean data, white noise", [r["sindy"]["terms"] > 0 for r in told if r["family"] in WHITE]),
        share("STLSQ:   in closed loop", [r["sindy"]["terms"] > 0 for r in told if r["family"] == "clean_closed"]),
        share("STLSQ:   coloured, heavy-tailed, quantised, jittered", [r["sindy"]["terms"] > 0 for r in told if r["family"] in ROUGH]),
        share(
            "STLSQ: one effect that matters: top term of the right kind", [r["sindy"]["right"] for r in one if (r["ratio"] or 0) >= STRONG]
        ),
        share(
            "STLSQ: one weak effect: top term of the right kind", [r["sindy"]["right"] for r in one if WEAK <= (r["ratio"] or 0) < STRONG]
        ),
        share("STLSQ: known unnamed kinds: top term is one it depends on", [r["sindy"]["right"] for r in told if r["family"] == "outside"]),
    ]
    return [row for row in rows_of if row.n]


def by(records: list[Record], key: str) -> list[str]:
    """Outcomes counted by a field of the records, or by `effect`."""
    counts: dict[str, dict[str, int]] = {}
    for r in records:
        label = "+".join(sorted(e["name"] for e in r["truth"])) or r.get("kind", "nothing") if key == "effect" else str(r.get(key))
        words = counts.setdefault(f"{r['family']:<16}{label}" if key != "family" else label, {})
        words[r["outcome"]] = words.get(r["outcome"], 0) + 1
    return [f"{label:<60}" + "  ".join(f"{w} {n}" for w, n in sorted(words.items())) for label, words in sorted(counts.items())]
