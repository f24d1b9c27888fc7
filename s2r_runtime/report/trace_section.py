"""What the tracer found, as a section of a page or a page of its own."""

from __future__ import annotations

from typing import Any

import numpy as np

from s2r_runtime.report import plots
from s2r_runtime.report.page import Page

SAY = {
    "none": ("Nothing beyond noise is left in the residual.", "good"),
    "traced": ("The residual is explained by the effects below.", "good"),
    "ambiguous": ("These effects cannot be told apart on this data.", "warn"),
    "unexplained": ("Structure is left that no effect in the library accounts for; it is not given a name.", "bad"),
    "sensor_fault": ("The measurements, not the motion, are wrong there.", "bad"),
}


def trace_page(result: Any) -> str:
    """The page of `s2r trace --report`."""
    page = Page("Residual, traced", f"{result.source} · {result.n_rows} rows")
    trace = {**result.to_json(), "plots": result.plots()}
    add_trace(page, trace)
    return page.html()


def add_trace(page: Page, trace: dict[str, Any]) -> None:
    """The section. trace: as `s2r trace --json` prints it, with `plots` if the figures are to be drawn."""
    verdict = trace["verdict"]
    text, kind = SAY[verdict]
    page.text(f"{verdict}: {text}", kind)
    if trace["effects"]:
        page.table(("effect", "acts on", "parameter", "value", "95 % interval"), list(_parameters(trace["effects"])))
    if trace["ambiguous_with"]:
        page.text("Cannot be told apart from: " + ", ".join(f"{e['name']}({e['channel']})" for e in trace["ambiguous_with"]), "warn")
    if trace["suggested_excitation"]:
        page.text(f"What would tell them apart: {trace['suggested_excitation']}")
    if trace["depends_on"]:
        page.text("What is left depends on: " + ", ".join(trace["depends_on"]), "warn")
    for fault in trace["faults"]:
        page.text(
            f"{fault['kind']} of {fault['channel']} from {fault['from_s']:.3f} s to {fault['to_s']:.3f} s; left out of the fit", "warn"
        )
    _errors(page, trace["error"])
    gap = trace.get("gap") or {}
    if gap.get("before") and gap.get("after"):
        before, after = gap["before"], gap["after"]
        page.text(f"Gap on transitions the fit never saw: {before['radius']:.4g} before, {after['radius']:.4g} after (N = {after['n']}).")
    if trace["candidates"]:
        page.heading("Candidates", 3)
        page.table(("effect", "acts on", "score"), [(c["name"], c["channel"], f"{c['score']:.1f}") for c in trace["candidates"][:12]])
    _figures(page, trace.get("plots") or {})


def _parameters(effects: list[dict[str, Any]]) -> list[tuple[str, str, str, str, str]]:
    rows = []
    for effect in effects:
        parameters: dict[str, dict[str, Any]] = effect["parameters"] or {"": {}}
        for name, p in parameters.items():
            value, low, high = p.get("value"), p.get("low"), p.get("high")
            number = f"{value:.5g} {p.get('unit', '')}" if isinstance(value, float) else str(value or "")
            interval = f"{low:.5g} to {high:.5g}" if isinstance(low, float) and isinstance(high, float) else "-"
            rows.append((effect["name"], effect["channel"], name, number, interval))
    return rows


def _errors(page: Page, error: dict[str, Any]) -> None:
    before, after, unit, floor = error["before"], error["after"], error["unit"], error["noise_floor"]
    horizon = before["rollout_horizon_s"]
    rows = [
        (
            f"{state} ({unit.get(state, '')})",
            f"{before['one_step_rms'][state]:.4g}",
            f"{after['one_step_rms'][state]:.4g}",
            f"{floor.get(state, 0.0):.4g}",
            f"{before['rollout_rms'][state]:.4g}",
            f"{after['rollout_rms'][state]:.4g}",
        )
        for state in before["one_step_rms"]
    ]
    page.table(("state", "one step, before", "after", "noise floor", f"after {horizon:g} s, before", "after"), rows)


def _figures(page: Page, figures: dict[str, Any]) -> None:
    for state, f in figures.get("residual", {}).items():
        t, before, after = (np.array(f[key]) for key in ("t", "before", "after"))
        page.figure(
            plots.series(
                {"before": (t, before, plots.ORANGE), "after": (t, after, plots.BLUE)},
                "s",
                f"residual of {state}",
                f"residual of {state} over time",
            ),
            f"One-step residual of {state} on held-out data.",
        )
        for name, x in f.get("against", {}).items():
            page.figure(
                plots.scatter_pair(np.array(x), before, after, name, f"residual of {state}", f"residual of {state} against {name}"),
                f"The same against {name}.",
            )
    for state, f in figures.get("autocorrelation", {}).items():
        lags = np.array(f["lag"])
        page.figure(
            plots.series(
                {"before": (lags, np.array(f["before"]), plots.ORANGE), "after": (lags, np.array(f["after"]), plots.BLUE)},
                "lag, steps",
                "autocorrelation",
                f"autocorrelation of the residual of {state}",
            ),
            f"Autocorrelation of the residual of {state}. Measurement noise alone gives -0.5 at lag 1 and 0 beyond.",
        )
    for state, f in figures.get("rollout", {}).items():
        t = np.array(f["t"])
        page.figure(
            plots.series(
                {
                    "measured": (t, np.array(f["measured"]), plots.INK),
                    "before": (t, np.array(f["before"]), plots.ORANGE),
                    "after": (t, np.array(f["after"]), plots.BLUE),
                },
                "s",
                state,
                f"rollout of {state} against measurement",
            ),
            f"Rollouts of {state} against what was measured.",
        )
