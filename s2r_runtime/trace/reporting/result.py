"""Result of a trace: as JSON (docs/json.md), as text, as arrays for plots, as a model."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from s2r_runtime.effects.classes import same
from s2r_runtime.models.composed import AppliedEffect, ComposedModel
from s2r_runtime.modelspec import ModelSpec
from s2r_runtime.plugins import registry
from s2r_runtime.recordings.table_rows import Subset
from s2r_runtime.trace.data.command_timing import before_changes
from s2r_runtime.trace.data.input_interpolation import Way
from s2r_runtime.trace.data.reconstruction import IN_PARTS, Reconstruction
from s2r_runtime.trace.diagnostics.detectability import Visible
from s2r_runtime.trace.diagnostics.rollout_error import Held, Judged
from s2r_runtime.trace.diagnostics.validity_domain import Range
from s2r_runtime.trace.diagnostics.validity_domain import told as validity_range
from s2r_runtime.trace.estimation.problem import insert
from s2r_runtime.trace.reporting.figures import views
from s2r_runtime.trace.reporting.found import Found, Limit
from s2r_runtime.trace.reporting.text import account
from s2r_runtime.trace.sensor_faults.fault import Fault
from s2r_runtime.trace.verdict import Verdict
from s2r_runtime.trace.version import VERSION

Array = NDArray[np.float64]
__all__ = ["Found", "Limit", "TraceResult"]


MEASURED = (
    "{}: taken for a measurement with noise, not for a command, because of the inverse dynamics; its scale, and effects on it, cannot be "
    "identified on this data"
)


@dataclass(frozen=True)
class TraceResult:
    """`spec`: the repaired model; the given one, if nothing was added, or if the alternatives matter little here and may do harm elsewhere.
    `partial`: effects that explain a part only. `repair`: their errors on held-out data, if they lower those of rollouts by 5 % or more;
    `spec` then has them.

    `depends_on`, `share_left`: of the residual of the final model. `floor`: rms errors of noise alone, (one step, rollout), (nx,) each.
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
    reconstruction: Reconstruction | None = None
    could_see: tuple[Visible, ...] = ()
    unseen: tuple[str, ...] = ()
    """States of the model that were not measured and that the motion does not require."""
    unconfirmed: tuple[tuple[str, str], ...] = ()
    """Name and channel of effects that the held-out data do not excite: only the fit supports them."""
    may_depend_on: tuple[str, ...] = ()
    """The part of `depends_on` that is only a caveat: visible in no rollout, or less certain."""
    any_shape_of: tuple[str, ...] = ()
    """The part of `depends_on` that indistinguishable explanations share: an unnamed effect may be the true one (`shared_dependence`)."""
    repair: Judged | None = None
    way: Way = field(default_factory=Way)
    """As in the dataset: how sampled inputs moved between samples."""
    noisy: dict[str, float] = field(default_factory=dict)
    """Standard deviation of the noise removed from each input, in its unit."""
    measured_forces: bool = False
    """As in the dataset: the inputs are measurements, not commands."""
    behind: dict[str, float] = field(default_factory=dict)
    """Delay in s, by state, relative to the other states of the pose; it was corrected."""
    forgetting: tuple[tuple[float, float], ...] = ()
    """As in the dataset: first samples of runs that were excluded, from and to, s."""
    unplaced: int = 0
    """Number of transitions excluded because a command changed in them at an unknown time."""
    domain: tuple[Range, ...] = ()
    """Range of validity of each state, then of each input."""
    subset: Subset | None = None
    """Samples of a long recording that were used; None: all. test_subset: of the hold-out recording."""
    test_subset: Subset | None = None
    notes: tuple[str, ...] = ()
    """How the columns were read, one sentence each."""

    def same(self, found: Found) -> tuple[Found, ...]:
        """Equivalents of an effect in `ambiguous_with`."""
        return tuple(e for e in self.ambiguous_with if e.same_thing and e.instead_of == ((found.name, found.channel),))

    @cached_property
    def rivals(self) -> tuple[Found, ...]:
        """Competing hypotheses in `ambiguous_with`: of equivalent ones the first, also if they are equivalent only nearly."""
        known = {name for e in self.effects for name in self._names_of(e)}
        kept: list[Found] = []
        for e in self.ambiguous_with:
            if not e.same_thing and (e.name, e.channel) not in known:
                kept.append(e)
                known |= self._names_of(e)
        return tuple(kept)

    def _names_of(self, e: Found) -> set[tuple[str, str]]:
        return {(name, channel) for name, channel, _ in same(self.model.for_effects, e.name, e.channel, e.values)}

    @property
    def blind(self) -> tuple[tuple[str, str], ...]:
        """(effect, channel) of effects that these data could not have shown, on channels without an effect."""
        there = {e.channel for e in self.effects}
        return tuple((v.name, v.channel) for v in self.could_see if v.size is None and v.channel not in there)

    @property
    def left_as_given(self) -> bool:
        """Whether the written model omits the effects."""
        return bool(self.effects) and self.spec.effects == self.nominal.spec.effects

    @property
    def done_to_data(self) -> tuple[str, ...]:
        """Treatment of the data before the fit, one line each."""
        lines = [one.text() + of for one, of in ((self.subset, ""), (self.test_subset, " of what it is judged on")) if one]
        lines += [] if self.reconstruction is None else self.reconstruction.text()
        if self.unseen:
            was = "was" if len(self.unseen) == 1 else "were"
            lines.append(f"{', '.join(self.unseen)} {was} not measured, and not needed: the motion follows from the inputs")
        if self.behind:
            who, others = ", ".join(self.behind), ", ".join(s for s in ("x", "y", "theta") if s not in self.behind)
            lags, was = ("lags", "was") if len(self.behind) == 1 else ("lag", "were")
            by = next(iter(self.behind.values()))
            lines.append(f"{who} {lags} {others} by {by:.3g} s, as the motion shows, and {was} shifted by that")
        of_test = self.held.data.forgetting if self.held.data.source != self.source else ()
        for stretches, of in ((self.forgetting, ""), (of_test, f" of {self.held.data.source}")):
            each = ", ".join(f"{a:.4g} to {b:.4g} s" for a, b in stretches[:3]) + (", ..." if len(stretches) > 3 else "")
            lines += [f"left out: {each}{of}; commands from before the recording may still act there"] if stretches else []
        apart = self.held.data if self.held.data.source != self.source else None
        for count, of in (
            (self.unplaced, ""),
            (len(before_changes(apart)) if apart and apart.unplaced else 0, f" of {apart.source}" if apart else ""),
        ):
            if count:
                lines.append(
                    f"left out: {count} transitions{of} in which a command changes between samples, at an unknown time "
                    "(record commands with their own timestamps)"
                )
        lines += self._inputs_taken()
        if self.unconfirmed:
            names = ", ".join(f"{name} on {channel}" for name, channel in self.unconfirmed)
            lines.append(f"not confirmed: {names}; the held-out data do not excite it, only the fit supports it")
        if self.effects:
            lines.append(f"range of validity: {validity_range(self.domain)}; untested outside")
        if self.left_as_given:
            lines.append("the model stays as it was given: the alternatives matter little here, and on other inputs one may do harm")
        if self.nominal.dt != self.spec.dt:
            longer = f"fitted and evaluated on steps of {self.nominal.dt:g} s, the shortest that are independent"
            lines.append(f"{longer}; the model's are {self.spec.dt:g} s")
        elif self._parts > 1 and self.reconstruction is None:
            lines.append(f"each step in {self._parts} parts, because inputs change within steps")
        return tuple(lines)

    @property
    def _parts(self) -> int:
        """Number of parts into which each step was divided."""
        return self.held.data.substeps if self.held.data.in_parts else 1

    def _inputs_taken(self) -> list[str]:
        """How sampled inputs were read, one line each."""
        lines = []
        if self.way.late:
            lines.append(
                "the inputs are one sample behind, as the motion shows (a mean over the previous sample?): each was taken from the next one"
            )
        if self.way.within:
            lines.append("commands changed between samples: each change was placed where the motion shows it")
        if any(self.way.on):
            shares = {f"{50.0 * on:.0f} % of the way" for on in self.way.on}
            if len(shares) == 1:
                lines.append(f"the inputs changed between samples, as the motion shows: each was taken {shares.pop()} to the next one")
            else:
                each = ", ".join(f"{name} {50.0 * on:.0f} %" for name, on in zip(self.nominal.inputs, self.way.on, strict=True) if on)
                lines.append(f"some inputs changed between samples, as the motion shows: taken that far to the next one ({each})")
        if self.measured_forces:
            lines.append(MEASURED.format(", ".join(self.nominal.inputs)))
        if self.noisy:
            each = ", ".join(f"{name} {size:.2g}" for name, size in self.noisy.items())
            lines.append(f"inputs are noisy samples, as the motion shows: the noise was removed (standard deviation: {each})")
        return lines

    @property
    def horizon_s(self) -> float:
        """Length of the rollouts, s."""
        return self.held.horizon * self.held.data.dt

    @property
    def explaining(self) -> ComposedModel:
        """Model of the result with the effects of `partial`."""
        model = self.model
        for found in self.partial:
            effect = AppliedEffect(registry().get("effects", found.name), found.channel, found.values)
            model = insert(model, effect, len(model.effects))
        return model

    def to_json(self) -> dict[str, Any]:
        """Plain data; numbers in SI."""
        states = self.nominal.states
        units: dict[str, str] = getattr(self.nominal.nominal, "units", {})
        return {
            "verdict": self.verdict,
            "tracer": VERSION,
            "effects": [e.to_json() for e in self.effects],
            "candidates": [{"name": n, "channel": c, "score": round(s, 3)} for n, c, s in self.candidates],
            "left_as_given": self.left_as_given,
            "ambiguous_with": [
                {**e.to_json(), "same_thing": e.same_thing, "instead_of": [{"name": n, "channel": c} for n, c in e.instead_of]}
                for e in self.ambiguous_with
            ],
            "partial": [e.to_json() for e in self.partial],
            "partial_error": None if self.repair is None else self.repair.error(states, self.horizon_s),
            "depends_on": list(self.depends_on),
            "may_depend_on": list(self.may_depend_on),
            "any_shape_of": list(self.any_shape_of),
            "suggested_excitation": self.suggested_excitation,
            "error": {
                "unit": {s: units.get(s, "") for s in states},
                "before": self.before.error(states, self.horizon_s),
                "after": self.after.error(states, self.horizon_s),
                "noise_floor": dict(zip(states, self.floor[0].tolist(), strict=True)),
                "rollout_noise_floor": dict(zip(states, self.floor[1].tolist(), strict=True)),
            },
            "gap": {"before": self.gap[0], "after": self.gap[1], "independent": self.gap[2]},
            "states_late": self.behind,
            "faults": [
                {"from_s": f.from_s, "to_s": f.to_s, "channel": f.channel, "kind": f.kind, "segment": f.segment or None}
                for f in self.faults
            ],
            "outliers": self.outliers,
            "first_left_out": [{"from_s": a, "to_s": b} for a, b in self.forgetting],
            "could_see": [
                {"name": v.name, "channel": v.channel, "parameter": v.parameter, "size": v.size, "unit": v.unit} for v in self.could_see
            ],
            "reconstructed": None if self.reconstruction is None else self.reconstruction.to_json(),
            "unmeasured": list(self.unseen),
            "inputs_moved_on": 0.5 * self.way.most,
            "inputs_noise": self.noisy,
            "inputs_measured": self.measured_forces,
            "inputs_late": self.way.late,
            "inputs_changed_within": self.way.within,
            "changes_left_out": self.unplaced,
            "unconfirmed": [{"name": name, "channel": channel} for name, channel in self.unconfirmed],
            "seen_within": {one.name: one.to_json() for one in self.domain},
            "step_s": self.nominal.dt,
            "step_parts": self._parts,
            "subset": self.subset.to_json() if self.subset else None,
            "test_subset": self.test_subset.to_json() if self.test_subset else None,
            "notes": list(self.notes),
            "n_fit": self.n_fit,
            "n_test": len(self.held.steps),
        }

    def comments(self) -> tuple[str, ...]:
        """Comments for the header of the model's TOML."""
        parts = self.reconstruction is not None and self.reconstruction.in_parts
        if self.repair is not None:
            partial = f"Partial repair by s2r trace on {self.source}: these effects lower the error, and more is missing"
            return (partial, *(e.text() for e in self.partial), f"Fitted or judged where {validity_range(self.domain)}")
        found = () if self.left_as_given else tuple(e.text() for e in self.effects)
        found += (f"Fitted or judged where {validity_range(self.domain)}",) if found else ()
        found += (IN_PARTS,) if parts else ()
        found += (MEASURED.format(", ".join(self.nominal.inputs)),) if found and self.measured_forces else ()
        return (
            (f"Repaired by s2r trace on {self.source}: {self.verdict}", *found)
            if found
            else (f"s2r trace on {self.source}: {self.verdict}",)
        )

    def text(self) -> str:
        """Text report."""
        return account(self)

    def plots(self) -> dict[str, Any]:
        """Arrays, as lists: residuals of what was held out over time and against what they may depend on, autocorrelation, rollouts."""
        return views(self)
