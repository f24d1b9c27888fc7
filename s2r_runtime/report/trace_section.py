"""What the tracer found, as a section of a page, from what `s2r trace --json` prints. The page of its own is `trace_page`."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Any

from s2r_runtime.report.page import Page
from s2r_runtime.trace.reporting.found import Found

SAY = {
    "none": ("nothing beyond noise is left in the residual.", "good"),
    "traced": ("the residual is explained by the effects below.", "good"),
    "ambiguous": ("these data cannot tell the effects below apart.", "warn"),
    "unexplained": ("structure is left that no effect in the library accounts for; it is not given a name.", "bad"),
    "sensor_fault": ("the measurements, not the motion, are wrong in places.", "bad"),
}

FAULTS = 40
"""Faults that are listed."""


def add_trace(page: Page, trace: dict[str, Any]) -> None:
    """The section without figures. trace: as `s2r trace --json` prints it."""
    text, kind = SAY[trace["verdict"]]
    shared, beside = trace.get("any_shape_of", []), trace.get("may_depend_on", [])
    left = [token for token in trace["depends_on"] if token not in {*shared, *beside}]
    if trace["verdict"] == "traced" and left:
        text, kind = "the effects below explain a part of the residual.", "warn"
    page.text(f"{trace['verdict']}: {text}", f"verdict {kind}")
    rows = list(_rows(trace["effects"], ""))
    for e in trace["ambiguous_with"]:
        if not _all_of_one(e):
            rows += _rows([e], _role(e, trace))
    rows += _rows(trace.get("partial", ()), "explains a part only")
    if rows:
        page.table(("", "effect", "acts on", "parameter", "value and 95 % interval", "that is"), rows)
    if trace["suggested_excitation"]:
        page.text(f"What would tell them apart: {trace['suggested_excitation']}")
    if shared:
        page.text(
            f"Or anything else that depends on {' and '.join(shared)}: where several do alike, or add up, one without a name may, too."
        )
    if left:
        page.text("What is left depends on: " + ", ".join(left), "warn")
    if beside:
        page.text(f"Less sure, but something may depend on {', '.join(beside)}: look at the name again.", "warn")
    _faults(page, trace["faults"])
    # what no dictionary took up of a structure without a name is still in it
    _errors(page, trace["error"], "noise alone" if trace["verdict"] != "unexplained" else "noise as estimated")
    _gap(page, trace.get("gap") or {})


def _all_of_one(other: dict[str, Any]) -> bool:
    """Whether it is the same effect on all inputs, of which there is one: nothing that a person need be told."""
    return bool(other.get("same_thing")) and other["channel"] == "*" and other["name"] in {e["name"] for e in other.get("instead_of", ())}


def _role(rival: dict[str, Any], trace: dict[str, Any]) -> str:
    """Of an entry of `ambiguous_with`; beside several effects it says which of them it stands for."""
    role = "the same thing on this model" if rival.get("same_thing", trace["verdict"] != "ambiguous") else "or"
    told = [f"{e['name']} on {e['channel']}" for e in rival.get("instead_of", ())]
    where = "as" if role != "or" else "in place of"
    return f"{role}, {where} {' and '.join(told)}" if told and len(trace["effects"]) > 1 else role


def _rows(effects: Sequence[dict[str, Any]], role: str) -> Iterator[tuple[str, str, str, str, str, str]]:
    """One row a parameter; what does not change is said once."""
    for effect in effects:
        values = {n: (p.get("value"), p.get("low"), p.get("high"), p.get("unit", "")) for n, p in effect["parameters"].items()}
        found = Found(effect["name"], effect["channel"], values)
        for i, (name, text) in enumerate([*found.value_texts()] or [("", "")]):
            first = i == 0
            yield (
                role if first else "",
                found.name if first else "",
                found.channel if first else "",
                name,
                text,
                found.words() if first else "",
            )


def _faults(page: Page, faults: Sequence[dict[str, Any]]) -> None:
    if not faults:
        return
    spoilt = any(f["kind"] != "late" for f in faults)  # a delay is corrected
    page.heading("Faults of measurement" + ("; affected samples are excluded" if spoilt else ""), 3)
    rows = [(f["kind"], f["channel"], f"{f['from_s']:.3f}", f"{f['to_s']:.3f}", f.get("segment") or "") for f in faults[:FAULTS]]
    several = any(row[-1] for row in rows)  # logs of before say nothing of it
    page.table(("kind", "of", "from (s)", "to (s)", "in segment")[: 4 + several], [row[: 4 + several] for row in rows])
    if len(faults) > FAULTS:
        page.text(f"and {len(faults) - FAULTS} more", "soft")


def _errors(page: Page, error: dict[str, Any], noise: str) -> None:
    """Before and after, angles in degrees too."""
    before, after, unit, floor = error["before"], error["after"], error["unit"], error["noise_floor"]
    rolled = error.get("rollout_noise_floor", {})
    same = before == after
    columns = [
        ("one step" if same else "one step, before", before["one_step_rms"]),
        ("after", after["one_step_rms"]),
        (noise, floor),
    ]
    over = f"over {before['rollout_horizon_s']:g} s"
    columns += [(over if same else f"{over}, before", before["rollout_rms"]), ("after", after["rollout_rms"]), (noise, rolled)]
    columns = [(name, values) for name, values in columns if not (same and name == "after")]
    rows = []
    for state in before["one_step_rms"]:
        units = [(unit.get(state, ""), 1.0)] + ([("deg", math.degrees(1.0))] if unit.get(state) == "rad" else [])
        for name, factor in units:
            cells = [f"{factor * values[state]:.3g}" if state in values else "" for _, values in columns]
            rows.append((f"{state} ({name})" if name else state, *cells))
    page.heading("Error on held-out data, rms", 3)
    page.table(("", *(name for name, _ in columns)), rows)


def _gap(page: Page, gap: dict[str, Any]) -> None:
    if not (gap.get("before") and gap.get("after")):
        return
    before, after = gap["before"], gap["after"]
    kind = "independent samples" if gap.get("independent") else "transitions; descriptive only, no confidence statement"
    page.text(f"Gap: {_pair(before, after, 'radius')}: the largest of {after['n']} {kind}.")
    if "hold_radius" in before:
        page.text(f"After {before['hold_periods']} held periods: {_pair(before, after, 'hold_radius')}.")


def _pair(before: dict[str, Any], after: dict[str, Any], key: str) -> str:
    return f"{before[key]:.4g}" if before == after else f"{before[key]:.4g} before, {after[key]:.4g} after"
