"""A task written in the profile: a law of scenarios as a table (`scenario_law`), and a formula of signal temporal logic as its metric.

    s = robustness of `metric` over the run (`stl.robustness`), >= 0 iff it holds;   or, with `barrier`,  s = least value of an expression

The formula sees the model's states, the scenario's names, and t, s since the start. `ends`: from the first sample at which it holds the
run counts as held there: nothing after that changes a value.

What the adversarial law pushes down (`clearance`) is the expression of that name; without one, the least of what the metric asks for
*always*, at the present state; where it asks for nothing always, its formula read as if all its intervals were now.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from s2r_runtime.errors import ConfigError
from s2r_runtime.hookspecs import NominalModel, Scenario
from s2r_runtime.tasks.parameters import known_name
from s2r_runtime.tasks.scenario_law import ScenarioLaw
from s2r_runtime.tasks.stl.robustness import Formula, compile_expression, compile_truth
from s2r_runtime.tasks.stl.syntax import (
    Always,
    And,
    Apply,
    Compare,
    Eventually,
    Name,
    Not,
    Number,
    Or,
    Truth,
    Until,
    is_instant,
    parts,
    positive,
)
from s2r_runtime.tasks.stl.text import parse_either, parse_expression, parse_truth

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]

NONE = "none"
STEPS_MAX = 1_000_000


@dataclass(frozen=True)
class Tally:
    """One sample of all runs, and the samples before it: a chain, so that taking note of one more copies nothing.

    leaves: what metric and progress have at this sample, (n,) each; ended: runs that are over; count: samples so far.
    """

    before: Tally | None
    leaves: tuple[Array, ...]
    ended: Bools
    count: int

    def __deepcopy__(self, memo: dict[int, Any]) -> Tally:
        """Nothing in it is ever changed."""
        return self


class StlTask:
    """Interface: `hookspecs.Task`. Any model."""

    name = "stl"
    PARAMETERS: ClassVar[dict[str, tuple[Any, str]]] = {
        "metric": ("", "the formula whose robustness is the safety value"),
        "barrier": ("", "instead of metric: an expression whose least value over the run is the safety value"),
        "horizon": (10.0, "how long a run is, s"),
        "start": ({}, "the law of the start, by state; states that are left out start at 0"),
        "scenario": ({}, "the law of the scenario's other numbers, by name"),
        "given": ("", "a formula on the numbers of the start: only scenarios of which it holds are drawn"),
        "ends": ("", "a formula without intervals: the run is over where it holds first"),
        "progress": ("", "a formula (its robustness) or an expression (its value at the end); 'none': the metric needs no other"),
        "min_progress": (0.0, "what the median of the progress must reach"),
        "clearance": ("", "an expression that the adversarial law pushes down"),
    }

    def __init__(self, parameters: dict[str, Any], model: NominalModel, dt: float) -> None:
        p = self._filled_in(parameters)
        self._dt, self._states = dt, model.states
        self.horizon = round(self._number(p, "horizon") / dt)
        if not 1 <= self.horizon <= STEPS_MAX:
            raise ConfigError(f"task stl: horizon is {p['horizon']} s, must be at least a step of {dt:g} s and at most {STEPS_MAX} steps")
        self._law = ScenarioLaw("stl", p["start"], p["scenario"], p["given"], model.states, model.angles)
        self._names = (*model.states, *self._law.names, "t")
        self._metric = self._metric_of(p)
        self._check_reach(self._metric, "metric")
        self._progress, self._at_end = self._progress_of(p)
        self._least_progress = self._number(p, "min_progress")
        self._clearance = self._clearance_of(p)
        self._ends: Callable[[dict[str, Any]], Any] | None = None
        if p["ends"]:
            truth = parse_truth(p["ends"], self._names, dt, "task stl: ends")
            if not is_instant(truth):
                raise ConfigError("task stl: ends has an interval; it may only say something of one instant")
            self._ends = compile_truth(truth)

    # ---------------------------------------------------------------- reading

    def _filled_in(self, given: dict[str, Any]) -> dict[str, Any]:
        for name, value in given.items():
            known_name("stl", name, self.PARAMETERS)
            kind = type(self.PARAMETERS[name][0])
            wanted = {str: "a text", dict: "a table", float: "a number"}[kind]
            if not isinstance(value, (int, float) if kind is float else kind) or isinstance(value, bool):
                raise ConfigError(f"task stl: {name} is {value!r}, must be {wanted}")
        return {name: given.get(name, default) for name, (default, _) in self.PARAMETERS.items()}

    @staticmethod
    def _number(p: dict[str, Any], name: str) -> float:
        value = float(p[name])
        if not np.isfinite(value):
            raise ConfigError(f"task stl: {name} is {value}, must be finite")
        return value

    def _metric_of(self, p: dict[str, Any]) -> Formula:
        if bool(p["metric"]) == bool(p["barrier"]):
            raise ConfigError('task stl: must have either metric, a formula such as "always (x < 2)", or barrier, an expression')
        if p["metric"]:
            formula = Formula.parse(p["metric"], self._names, self._dt, "task stl: metric")
            if never := _never_fails(positive(formula.truth)):
                raise ConfigError(
                    f"task stl: metric, column {never.column}: that two numbers differ never has a robustness below 0, so it could "
                    "not fail; write it with < and >, as in gear < 2.5 or gear > 3.5"
                )
            return formula
        barrier = parse_expression(p["barrier"], self._names, "task stl: barrier")
        return Formula(Always(0, None, Compare(">=", barrier, Number(0.0))), p["barrier"])

    def _progress_of(self, p: dict[str, Any]) -> tuple[Formula | None, bool]:
        """(what tells the progress, whether it is the value at the end); None: there is no requirement."""
        text = p["progress"]
        if text == NONE:
            return None, False
        if not text:
            if _asks_for_something(positive(self._metric.truth)):
                return self._metric, False
            raise ConfigError(
                "task stl: progress is missing, and the metric asks for nothing to happen: a robot that stands still would pass; "
                'give a formula such as "eventually (x > 1)", or "none" if that is right'
            )
        node = parse_either(text, self._names, self._dt, "task stl: progress")
        if isinstance(node, Number | Name | Apply):
            return Formula(Compare(">=", node, Number(0.0)), text), True
        formula = Formula(node, text)
        self._check_reach(formula, "progress")
        return formula, False

    def _clearance_of(self, p: dict[str, Any]) -> Callable[[dict[str, Any]], Any]:
        if p["clearance"]:
            return compile_expression(parse_expression(p["clearance"], self._names, "task stl: clearance"))
        truth = positive(self._metric.truth)
        always = _always(truth)
        return compile_truth(_now(truth) if always is None else always)

    def _check_reach(self, formula: Formula, what: str) -> None:
        if formula.reach > self.horizon:
            raise ConfigError(
                f"task stl: {what} looks {formula.reach * self._dt:g} s ahead, the horizon is {self.horizon * self._dt:g} s; "
                "what lies behind the horizon would count as nothing"
            )

    # ---------------------------------------------------------------- the law

    def draw(self, rng: np.random.Generator, n: int) -> Scenario:
        """n scenarios from the law, independent. Raises ConfigError if there are none."""
        return self._scenario(self._law.draw(rng, n))

    def draw_at(self, rng: np.random.Generator, x: Array) -> Scenario:
        """One scenario from the law given that the robot starts at x (nx,). Raises NotEnoughEvidence where the law has none."""
        return self._scenario(self._law.draw_at(rng, np.asarray(x, dtype=np.float64)))

    def _scenario(self, values: dict[str, Array]) -> Scenario:
        start = np.asfortranarray(np.stack([values[name] for name in self._states], axis=1))
        return {"start": start, "step": np.zeros(len(start), dtype=np.int64), **{name: values[name] for name in self._law.names}}

    def advance(self, scenario: Scenario, rng: np.random.Generator) -> Scenario:
        """Time goes on. What moves is written with t."""
        return {**scenario, "step": scenario["step"] + 1}

    def view(self, scenario: Scenario) -> Scenario:
        """The scenario's names, (n,) each; t and time_left (n,) s."""
        step = scenario["step"]
        told = {name: scenario[name] for name in self._law.names}
        return {**told, "t": step * self._dt, "time_left": (self.horizon - step) * self._dt}

    # ---------------------------------------------------------------- safety

    def _signals(self, x: Array, scenario: Scenario) -> dict[str, Any]:
        states = {name: x[:, column] for column, name in enumerate(self._states)}  # a state that is called t is meant by t
        return {"t": scenario["step"] * self._dt, **{name: scenario[name] for name in self._law.names}, **states}

    def clearance(self, x: Array, scenario: Scenario) -> Array | None:
        """See the module's docstring, (n,)."""
        with np.errstate(all="ignore"):
            return np.array(np.broadcast_to(self._clearance(self._signals(x, scenario)), (len(x),)), dtype=np.float64)

    def begin(self, scenario: Scenario) -> Tally:
        """Nothing has happened."""
        return Tally(None, (), np.zeros(len(scenario["step"]), dtype=np.bool_), 0)

    def observe(self, tally: Tally, x: Array, scenario: Scenario) -> Tally:
        """Takes note of the leaves at x (n, nx); of runs that are over, of what they had."""
        signals, n = self._signals(x, scenario), len(x)
        leaves = self._metric.leaves(signals, n)
        if self._progress is not None and self._progress is not self._metric:
            leaves += self._progress.leaves(signals, n)
        ended = tally.ended
        if self._ends is not None:
            if ended.any():
                leaves = tuple(np.where(ended, was, now) for was, now in zip(tally.leaves, leaves, strict=True))
            with np.errstate(all="ignore"):
                ended = ended | (np.broadcast_to(self._ends(signals), (n,)) >= 0.0)
        return Tally(tally, leaves, ended, tally.count + 1)

    def _traces(self, tally: Tally) -> list[Array]:
        """The leaves over the run so far, (T, n) each; where all runs are over, to the horizon."""
        rows: list[tuple[Array, ...]] = []
        at: Tally | None = tally
        while at is not None and at.count:
            rows.append(at.leaves)
            at = at.before
        rows.reverse()
        if tally.ended.all():
            rows += [tally.leaves] * (self.horizon + 1 - len(rows))
        return [np.stack(leaf) for leaf in zip(*rows, strict=True)]

    def safety(self, tally: Tally) -> Array:
        """Robustness of the metric over the run so far, (n,); inf before it began."""
        if not tally.count:
            return np.full(len(tally.ended), np.inf)
        return np.asarray(self._metric.of_leaves(self._traces(tally))[0])

    def progress(self, tally: Tally) -> Array:
        """Robustness of `progress`, or its value at the end, (n,)."""
        if self._progress is None or not tally.count:
            return np.zeros(len(tally.ended))
        if self._at_end:
            return np.asarray(tally.leaves[-1])
        found = self._traces(tally)
        return np.asarray(self._progress.of_leaves(found if self._progress is self._metric else found[self._metric.width :])[0])

    def done(self, tally: Tally) -> Bools:
        """Where `ends` held."""
        return tally.ended

    def progress_ok(self, progress: Array) -> bool:
        """Whether the median is at least `min_progress`."""
        return self._progress is None or bool(np.median(progress) >= self._least_progress)


def _never_fails(truth: Truth, *, negated: bool = False) -> Compare | None:
    """A comparison that says `differs`, whatever the numbers. truth: in positive form."""
    match truth:
        case Compare():
            return truth if truth.operator == ("==" if negated else "!=") else None
        case Not():
            return _never_fails(truth.part, negated=not negated)
        case _:
            return next((found for part in parts(truth) if (found := _never_fails(part, negated=negated))), None)


def _asks_for_something(truth: Truth) -> bool:
    """Whether it has an eventually or until that must hold. truth: in positive form."""
    match truth:
        case Eventually() | Until():
            return True
        case Not():  # of an until
            return False
        case _:
            return any(_asks_for_something(part) for part in parts(truth))


def _always(truth: Truth) -> Truth | None:
    """The conjunction of what must hold always, of one instant each; None if there is none."""
    match truth:
        case Always() if is_instant(truth.part):
            return truth.part
        case And():
            left, right = _always(truth.left), _always(truth.right)
            return And(left, right) if left is not None and right is not None else left or right
        case _:
            return None


def _now(truth: Truth) -> Truth:
    """As if all its intervals were now."""
    match truth:
        case Always() | Eventually():
            return _now(truth.part)
        case Until():
            return And(_now(truth.left), _now(truth.right))
        case Not():
            return Not(_now(truth.part))
        case And() | Or():
            return type(truth)(_now(truth.left), _now(truth.right))
        case Compare():
            return truth
