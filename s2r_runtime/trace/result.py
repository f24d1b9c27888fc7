"""What the tracer found: as JSON (docs/json.md), as a short account, as arrays for plots, as a model."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from s2r_runtime.models.composed import ComposedModel
from s2r_runtime.modelspec import ModelSpec
from s2r_runtime.trace.errors import Held, Judged
from s2r_runtime.trace.faults import Fault
from s2r_runtime.trace.power import Visible
from s2r_runtime.trace.residual import acting, first_steps, rms
from s2r_runtime.trace.verdict import Verdict

Array = NDArray[np.float64]
Limit = float | list[list[float | None]] | None
Value = tuple[Any, Limit, Limit, str]
"""Value, low and high end of its 95 % interval (in the shape of the value; None where there is none), unit."""

POINTS = 4000
"""Points of a curve in `plots` at most."""

UNLIMITED = 1e5
"""Ends of intervals beyond it are bounds of the parameter, not findings."""

LISTED = 8
"""Faults that the account lists one by one."""

LAGS = 40
"""Steps of the autocorrelation."""


@dataclass(frozen=True)
class Found:
    """An effect. parameters: name -> (value, low, high, unit); low and high: 95 % interval, None where there is none."""

    name: str
    channel: str
    parameters: dict[str, Value]

    def to_json(self) -> dict[str, Any]:
        """the form of docs/json.md."""
        values = {n: {"value": v, "low": low, "high": high, "unit": unit} for n, (v, low, high, unit) in self.parameters.items()}
        return {"name": self.name, "channel": self.channel, "parameters": values}

    def text(self) -> str:
        """One line."""
        told = []
        for name, (value, low, high, unit) in self.parameters.items():
            number = f"{value:.4g}{' ' + unit if unit else ''}" if isinstance(value, float) else str(value)
            told.append(f"{name} = {number}{_range(low, high)}")
        return f"{self.name} on {self.channel}: " + ", ".join(told)


@dataclass(frozen=True)
class TraceResult:
    """`spec`: the repaired model (the given one, if nothing was added). `partial`: effects found on the way whose names were withdrawn.

    `depends_on`, `share_left`: of what the final model leaves. `floor`: what noise alone makes, (one step, rollout), (nx,) each.
    """

    verdict: Verdict
    effects: tuple[Found, ...]
    partial: tuple[Found, ...]
    ambiguous_with: tuple[Found, ...]
    candidates: tuple[tuple[str, str, float], ...]
    depends_on: tuple[str, ...]
    share_left: float
    suggested_excitation: str | None
    faults: tuple[Fault, ...]
    outliers: int
    spec: ModelSpec
    model: ComposedModel
    nominal: ComposedModel
    before: Judged
    after: Judged
    floor: tuple[Array, Array]
    gap: tuple[dict[str, Any], dict[str, Any], bool]
    held: Held
    n_fit: int
    n_rows: int
    source: str
    interpolated: bool
    could_see: tuple[Visible, ...] = ()

    @property
    def horizon_s(self) -> float:
        """Of the rollouts."""
        return self.held.horizon * self.held.data.dt

    def to_json(self) -> dict[str, Any]:
        """Plain data; numbers in SI."""
        states = self.nominal.states
        units: dict[str, str] = getattr(self.nominal.nominal, "units", {})
        return {
            "verdict": self.verdict,
            "effects": [e.to_json() for e in self.effects],
            "candidates": [{"name": n, "channel": c, "score": round(s, 3)} for n, c, s in self.candidates],
            "ambiguous_with": [e.to_json() for e in self.ambiguous_with],
            "partial": [e.to_json() for e in self.partial],
            "depends_on": list(self.depends_on),
            "suggested_excitation": self.suggested_excitation,
            "error": {
                "unit": {s: units.get(s, "") for s in states},
                "before": self.before.error(states, self.horizon_s),
                "after": self.after.error(states, self.horizon_s),
                "noise_floor": dict(zip(states, self.floor[0].tolist(), strict=True)),
                "rollout_noise_floor": dict(zip(states, self.floor[1].tolist(), strict=True)),
            },
            "gap": {"before": self.gap[0], "after": self.gap[1], "independent": self.gap[2]},
            "faults": [{"from_s": f.from_s, "to_s": f.to_s, "channel": f.channel, "kind": f.kind} for f in self.faults],
            "outliers": self.outliers,
            "could_see": [
                {"name": v.name, "channel": v.channel, "parameter": v.parameter, "size": v.size, "unit": v.unit} for v in self.could_see
            ],
            "n_fit": self.n_fit,
            "n_test": len(self.held.steps),
        }

    def comments(self) -> tuple[str, ...]:
        """For the head of the model's TOML."""
        found = tuple(e.text() for e in self.effects)
        return (
            (f"Repaired by s2r trace on {self.source}: {self.verdict}", *found)
            if found
            else (f"s2r trace on {self.source}: {self.verdict}",)
        )

    def text(self) -> str:
        """A short account for a person."""
        lines = [f"{self.verdict}: {_SAID[self.verdict]}"]
        lines += [f"  {e.text()}" for e in self.effects]
        if self.ambiguous_with:
            lines += ["cannot be told from:", *(f"  {e.text()}" for e in self.ambiguous_with)]
            lines.append(f"what would tell them apart: {self.suggested_excitation}")
        if self.partial:
            lines += ["explains a part, so no name is lent to it:", *(f"  {e.text()}" for e in self.partial)]
        if self.depends_on:
            lines.append(_left(self.depends_on, self.share_left, bool(self.effects)))
        lines += _fault_lines(self.faults)
        if self.outliers:
            lines.append(f"{self.outliers} outlying rows count for next to nothing")
        lines += ["", *self._table(), ""]
        before, after, independent = self.gap
        kind = "independent samples" if independent else "transitions of the drive, which bound no other (no statement)"
        lines.append(f"gap: {before['radius']:.4g} -> {after['radius']:.4g} on {before['n']} {kind}")
        if "hold_radius" in before:
            lines.append(f"after {before['hold_periods']} held periods: {before['hold_radius']:.4g} -> {after['hold_radius']:.4g}")
        lines.append(f"fitted on {self.n_fit} transitions, judged on {len(self.held.steps)} that the fit never saw")
        if self.interpolated:
            lines.append("states were interpolated to the model's step: they were not recorded on it")
        return "\n".join(lines)

    def _table(self) -> list[str]:
        states = self.nominal.states
        units: dict[str, str] = getattr(self.nominal.nominal, "units", {})
        columns = [rms(self.before.one_step), rms(self.after.one_step), self.floor[0]]
        if len(self.before.ends):
            columns += [rms(self.before.ends), rms(self.after.ends), self.floor[1]]
        head = f"{'held-out rms':<22}{'one step':>12}{'after':>11}{'noise':>11}"
        head += f"{f'{self.horizon_s:g} s':>12}{'after':>11}{'noise':>11}" if len(columns) > 3 else ""
        rows = []
        for i, state in enumerate(states):
            label = f"{state} ({units[state]})" if units.get(state) else state
            rows.append(f"{label:<22}" + "".join(f"{c[i]:>{12 if j % 3 == 0 else 11}.4g}" for j, c in enumerate(columns)))
        return [head, *rows]

    def plots(self) -> dict[str, Any]:
        """Arrays, as lists, for the report: residual of each state over time and against what it may depend on, its
        autocorrelation, and rollouts against measurement; all on what was held out, before and after.
        """
        steps, states = self.held.steps, self.nominal.states
        thin = slice(None, None, max(1, len(steps) // POINTS))
        u = acting(self.nominal, self.held.data).mean[steps.place]
        against = {name: u[thin, j].tolist() for j, name in enumerate(self.nominal.inputs)}
        against |= {name: _wrapped(steps.y0[thin, states.index(name)]).tolist() for name in self.nominal.nominal.angles}
        residual, correlation = {}, {}
        for i, state in enumerate(states):
            before, after = self.before.one_step[:, i], self.after.one_step[:, i]
            residual[state] = {
                "t": steps.t[thin].tolist(),
                "before": before[thin].tolist(),
                "after": after[thin].tolist(),
                "against": against,
            }
            lags = min(LAGS, max(1, len(before) // 4))
            correlation[state] = {
                "lag": list(range(1, lags + 1)),
                "before": _autocorrelation(before, lags),
                "after": _autocorrelation(after, lags),
            }
        return {"residual": residual, "autocorrelation": correlation, "rollout": self._rollouts()}

    def _rollouts(self) -> dict[str, Any]:
        """Rollouts one after the other through a stretch of what was held out, each begun at the measured state."""
        data, horizon = self.held.data, self.held.horizon
        run = int(self.held.steps.run[0])
        begin = first_steps(data)[run]
        first = int(self.held.steps.place[0] - begin)
        y = data.runs[run].y
        seen = np.flatnonzero(~self.held.within[begin + first : begin + len(y) - 1])
        last = min(len(y) - 1, first + max(8 * horizon, 100), first + POINTS, *(first + seen[:1]).tolist())
        curves: list[Array] = []
        for model in (self.nominal, self.model):
            act = acting(model, data)
            x = np.full((last - first + 1, y.shape[1]), np.nan)
            for k in range(first, last):
                if (k - first) % horizon == 0 or np.isnan(x[k - first]).any():
                    x[k - first] = y[k]
                place = slice(begin + k, begin + k + 1)
                x[k - first + 1] = model.advance(x[k - first][None, :], act.mean[place], act.end[place])[0]
            curves.append(x)
        good = ~(np.isnan(y[first : last + 1]).any(axis=1) | np.isnan(curves[0]).any(axis=1) | np.isnan(curves[1]).any(axis=1))
        t = data.runs[run].start_s + data.dt * np.arange(first, last + 1)
        return {
            state: {
                "t": t[good].tolist(),
                "measured": y[first : last + 1, i][good].tolist(),
                "before": curves[0][good, i].tolist(),
                "after": curves[1][good, i].tolist(),
            }
            for i, state in enumerate(self.nominal.states)
        }


_SAID = {
    "none": "nothing beyond noise is left in the residual",
    "traced": "the residual is explained by",
    "ambiguous": "these data cannot decide between effects; the best is",
    "unexplained": "structure is left that no effect in the library accounts for",
    "sensor_fault": "the measurements, not the motion, are wrong in places",
}


def _range(low: Limit, high: Limit) -> str:
    """The interval in brackets; an end at a parameter's bound says that the data do not limit it there."""
    if not isinstance(low, float) or not isinstance(high, float):
        return ""
    if abs(low) >= UNLIMITED or abs(high) >= UNLIMITED:
        ends = [f"at least {low:.4g}" if abs(low) < UNLIMITED else "", f"at most {high:.4g}" if abs(high) < UNLIMITED else ""]
        return f" ({', '.join(end for end in ends if end) or 'not limited by these data'})"
    return f" ({low:.4g} to {high:.4g})"


def _left(tokens: tuple[str, ...], share: float, named: bool) -> str:
    if tokens == ("noise",):
        return "the noise is coloured: correlated in time, whatever the inputs do"
    much = f" ({100.0 * share:.0f} % of what the model lacked)" if named else ""
    return f"what is left{much} depends on: {', '.join(tokens)}"


def _fault_lines(faults: tuple[Fault, ...]) -> list[str]:
    loud = [f for f in faults if f.kind != "dropout"]
    lines = [f"{f.kind} of {f.channel} from {f.from_s:.3f} s to {f.to_s:.3f} s, left out of the fit" for f in loud[:LISTED]]
    lines += [f"and {len(loud) - LISTED} more faults of measurement"] if len(loud) > LISTED else []
    silent = [f for f in faults if f.kind == "dropout"]
    if silent:
        lines.append(f"{len(silent)} dropout{'s' if len(silent) > 1 else ''}, the longest {max(f.to_s - f.from_s for f in silent):.3g} s")
    return lines


def _autocorrelation(e: Array, lags: int) -> list[float]:
    e = e - float(np.mean(e))
    total = float(e @ e)
    return [float(e[lag:] @ e[:-lag]) / total if total > 0.0 else 0.0 for lag in range(1, lags + 1)]


def _wrapped(angle: Array) -> Array:
    return np.asarray((angle + np.pi) % (2.0 * np.pi) - np.pi)
