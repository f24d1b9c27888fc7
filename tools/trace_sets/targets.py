"""The blind targets of the tracer, one row each, from records of sets (docs/tracing.md, How it is tested).

A share's interval is the exact one of Clopper and Pearson, 95 %. A target is met if the observed share meets it; the
interval says how sure that is.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.special import betaincinv

Record = dict[str, Any]

RIGHT, NOT_WRONG = {"right"}, {"right", "tie", "none"}
NAMED = {"one", "weak"}
WHITE = {"clean", "clean_closed", "clean_quantised"}
ROUGH = {"clean_coloured", "clean_outliers", "clean_student", "clean_jittered"}


@dataclass(frozen=True)
class Row:
    """what; k of n; the share (or figure) found, its interval, what was asked, and whether that is met (None: nothing to judge by)."""

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
    """Share of the error reduction that was there to be reached."""
    again = record.get("again")
    if not again:
        return None
    nominal, repaired, oracle = again[kind]
    return float((nominal - repaired) / max(nominal - oracle, 1e-12))


def rows(records: list[Record]) -> list[Row]:
    """Every target."""
    done = [r for r in records if r["outcome"] not in {"refused", "crash"}]

    def of(*expect: str) -> list[Record]:
        return [r for r in done if r["expect"] in expect]

    one = [r for r in of("one") if r["ratio"] is not None]
    strong, weak = [r for r in one if r["ratio"] >= 1.5], [r for r in one if 1.1 <= r["ratio"] < 1.5]
    outside, named = of("outside"), [*one, *of("pair")]
    told = [inside for r in named for _, inside in r["covered"]]
    share = [x for x in (reached(r) for r in [*strong, *of("pair")]) if x is not None]
    changed = [r for r in done if r.get("again") and r["verdict"] in {"traced", "ambiguous"}]
    worse = [r["again"]["noisy"][1] > 1.02 * r["again"]["noisy"][0] for r in changed]
    short = [r["cpu_s"] for r in done if 1000 <= r["n"] <= 1500]
    long = [r["cpu_s"] for r in done if r["n"] >= 50_000]
    return [
        _share("false alarms, clean, white noise", (r["outcome"] == "alarm" for r in done if r["family"] in WHITE), 0.01, at_most=True),
        _share("  of these in closed loop", (r["outcome"] == "alarm" for r in done if r["family"] == "clean_closed"), 0.01, at_most=True),
        _share(
            "false alarms, clean, coloured, outliers, jittered",
            (r["outcome"] == "alarm" for r in done if r["family"] in ROUGH),
            0.05,
            at_most=True,
        ),
        _share("one effect that matters (>= 1.5): right name", (r["outcome"] in RIGHT for r in strong), 0.90),
        _share("  right name or honest tie", (r["outcome"] in {"right", "tie"} for r in strong), 0.90),
        _share("one weak effect (1.1 to 1.5): right, tie or none", (r["outcome"] in NOT_WRONG for r in weak), 0.85),
        _share("one effect: wrong name", (r["outcome"] == "wrong" for r in one), 0.03, at_most=True),
        _share("two effects: exact pair", (r["outcome"] == "right" for r in of("pair")), 0.75),
        _share("outside the library: unflagged false name", (r["outcome"] == "false_name" for r in outside), 0.10, at_most=True),
        _share("outside the library: right depends_on", (r["depends_right"] for r in outside), 0.70),
        _share("not separable by construction: tie reported", (r["outcome"] == "tie" for r in of("tie")), 0.90),
        _figure("error reduction reached, median (effects that matter, pairs)", share, lambda v: float(np.median(v)), 0.97),
        _figure("error reduction reached, 10th percentile", share, lambda v: float(np.quantile(v, 0.1)), 0.85),
        _share("95 % intervals that cover", told, 0.90, high=0.98),
        _share("repaired model worse than nominal", worse, 0.01, at_most=True),
        _figure("CPU s, 1000 to 1500 rows, 90th percentile", short, lambda v: float(np.quantile(v, 0.9)), 2.0, at_most=True, form=".2f"),
        _figure("CPU s, 50 000 to 100 000 rows, most", long, max, 60.0, at_most=True, form=".1f"),
        _share(
            "refused without need, or crashed",
            (r["outcome"] in {"refused", "crash"} for r in records if r["expect"] != "bad"),
            0.0,
            at_most=True,
        ),
    ]
