"""What the runtime relies on in an effect (hookspecs.Effect): that it is the same thing step by step, over time, and in parts of a step;
that rows and runs do not mix; and that every claim it makes (`linear`, `shift`, `within_step`, `timed`…) is true.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
from numpy.typing import NDArray

from s2r_runtime.hookspecs import Effect, NominalModel
from s2r_runtime.models.composed import compose, takes
from s2r_runtime.modelspec import EffectSpec, ModelSpec, dump_model, load_model
from s2r_runtime.plugins import registry
from s2r_runtime.testing.effect_claims import additive_gap, first_of, linear_gap, shift_gap

Array = NDArray[np.float64]
Case = tuple[NominalModel, str]
Values = dict[str, Any]

DT = 0.033
MOST_STARTS = 20
"""The tracer pays time for each: rarely are more than eight worth it."""
PARTS = 64
"""Of a step, fine enough to see where it ends."""


class Plain:
    """A model that says nothing of itself but what it must, as somebody's own file does."""

    name = "plain"
    states = ("a", "b", "c")
    inputs = ("p", "q", "r")
    angles = ()
    parameters: ClassVar[dict[str, float]] = {"vigour": 1.0, "decay": 0.0}

    def step(self, x: Array, u: Array, dt: float, parameters: dict[str, float]) -> Array:
        """x + dt (vigour u - decay x)."""
        return np.asarray(x + dt * (parameters["vigour"] * u - parameters["decay"] * x))


class EffectKit:
    """Subclass with `effect` and `parameters`: values at which it does something. others: further sets, of which one may leave out what is
    optional. A parameter that names another input gets the model's. models: those on which to try it; default: all registered ones on which
    it has a channel, and one that has no units.
    """

    effect: ClassVar[Any]
    parameters: ClassVar[dict[str, Any]]
    others: ClassVar[tuple[dict[str, Any], ...]] = ()
    models: ClassVar[tuple[str, ...]] = ()

    @pytest.fixture
    def cases(self) -> list[Case]:
        """(model, channel) for every channel of every model."""
        models = [registry().get("models", name) for name in self.models or registry().names("models")]
        found = [
            (model, channel) for model in ([*models] if self.models else [*models, Plain()]) for channel in self.effect.channels(model)
        ]
        assert found, "the effect has no channel on any of these models"
        return found

    # ------------------------------------------------------------ the same thing, however it is asked

    def test_over_time_at_once_is_the_same_as_step_by_step(self, cases: list[Case]) -> None:
        self._only_on_inputs()
        for model, channel, p in self._tried(cases):
            u = self._inputs(model, 100)
            at_once = self.effect.input_sequence(u, model, channel, DT, p)
            assert at_once.shape == u.shape
            np.testing.assert_allclose(at_once, self._stepped(u, model, channel, p), rtol=1e-9, atol=1e-12)

    def test_a_step_is_the_mean_of_its_parts(self, cases: list[Case]) -> None:
        """The runtime takes a step in parts where what acts changes within it."""
        self._only_on_inputs()
        for model, channel, p in self._tried(cases):
            u = self._inputs(model, 60)
            parts = self.effect.input_sequence(np.repeat(u, 4, axis=0), model, channel, DT / 4, p).reshape(60, 4, -1)
            np.testing.assert_allclose(self.effect.input_sequence(u, model, channel, DT, p), parts.mean(axis=1), rtol=1e-9, atol=1e-11)
            if hasattr(self.effect, "within_step") and not self.effect.within_step(DT, p):
                assert np.allclose(parts, parts[:, :1], rtol=1e-9, atol=1e-11), "within_step says that nothing changes within a step"

    def test_what_acts_at_a_steps_end_is_where_its_parts_get_to(self, cases: list[Case]) -> None:
        """A wheel's speed is what acts at the end of a step, not on average over it."""
        if not hasattr(self.effect, "at_end"):
            pytest.skip("does not say it")
        for model, channel, p in self._tried(cases):
            u = self._inputs(model, 60)
            acting = self.effect.input_sequence(u, model, channel, DT, p)
            when = DT * np.arange(60.0)[:, None] if getattr(self.effect, "timed", False) else None
            ends = self.effect.at_end((u, acting, u), when, model, channel, DT, p)
            fine = self.effect.input_sequence(np.repeat(u, PARTS, axis=0), model, channel, DT / PARTS, p).reshape(60, PARTS, -1)
            change = np.diff(fine[:, -3:], axis=1)
            going = np.abs(change[:, 1]) + np.abs(change[:, 1] - change[:, 0])  # on average the last part is half a change short of its end
            assert np.all(np.abs(ends - fine[:, -1]) <= going + 1e-9), "at_end is not where the last part of a step gets to"

    def test_runs_side_by_side_are_the_same_as_one_after_the_other(self, cases: list[Case]) -> None:
        if not getattr(self.effect, "side_by_side", False):
            pytest.skip("does not claim it")
        for model, channel, p in self._tried(cases):
            for runs in (3, 70):
                u = np.random.default_rng(3).normal(size=(24, runs, len(model.inputs))).round(1)
                u[5:15] = u[5]
                together = self.effect.input_sequence(u, model, channel, DT, p)
                alone = [self.effect.input_sequence(u[:, i], model, channel, DT, p) for i in range(runs)]
                np.testing.assert_allclose(together, np.stack(alone, axis=1), rtol=1e-9, atol=1e-12)

    def test_rows_do_not_mix_and_shapes_stay(self, cases: list[Case]) -> None:
        for model, channel, p in self._tried(cases):
            x, u = self._states(model, 7), self._inputs(model, 10)[:7]
            one = self._step(model, channel, x, u, p)
            assert one.shape == (u if self.effect.stage == "input" else x).shape
            assert np.isfinite(one).all()
            for i in range(7):
                np.testing.assert_allclose(one[i], self._step(model, channel, x[i : i + 1], u[i : i + 1], p)[0], rtol=1e-12, atol=1e-15)

    def test_arguments_are_not_changed(self, cases: list[Case]) -> None:
        for model, channel, p in self._tried(cases):
            x, u = self._states(model, 4), self._inputs(model, 10)[:4]
            given = x.copy(), u.copy(), dict(p)
            self._step(model, channel, x, u, p)
            assert (x == given[0]).all()
            assert (u == given[1]).all()
            assert p == given[2]

    def test_rest_is_what_zero_input_leaves(self, cases: list[Case]) -> None:
        self._only_on_inputs()
        clock = 1 if getattr(self.effect, "timed", False) else 0
        for model, channel, p in self._tried(cases):
            z = self.effect.hidden(3, model, channel, DT, p)
            assert z.shape[0] == 3
            after = self.effect.input_step(np.zeros((3, len(model.inputs))), z, model, channel, DT, p)[1]
            np.testing.assert_allclose(after[:, clock:], z[:, clock:], rtol=1e-12, atol=1e-15)

    def test_measured_and_true_states_are_inverses(self, cases: list[Case]) -> None:
        if self.effect.stage != "sensor":
            pytest.skip("is no sensor's")
        for model, channel, p in self._tried(cases):
            x = self._states(model, 9)
            measured = self.effect.to_measured(x, model, channel, p)
            np.testing.assert_allclose(self.effect.to_true(measured, model, channel, p), x, rtol=1e-12, atol=1e-12)

    # ------------------------------------------------------------ time

    def test_a_run_that_begins_later_knows_its_time(self, cases: list[Case]) -> None:
        if not getattr(self.effect, "timed", False):
            pytest.skip("does not depend on time")
        for model, channel, p in self._tried(cases):
            u = self._inputs(model, 60)
            for start in (0.0, 0.7, -0.5):
                at_once = self.effect.input_sequence(u, model, channel, DT, p, start=start)
                np.testing.assert_allclose(at_once, self._stepped(u, model, channel, p, start), rtol=1e-9, atol=1e-12)
            starts = np.array([0.0, 0.7, -0.5])
            together = self.effect.input_sequence(np.stack([u] * 3, axis=1), model, channel, DT, p, start=starts)
            for i, start in enumerate(starts.tolist()):
                alone = self.effect.input_sequence(u, model, channel, DT, p, start=start)
                np.testing.assert_allclose(together[:, i], alone, rtol=1e-9, atol=1e-12)

    def test_before_the_start_it_is_as_at_the_start(self, cases: list[Case]) -> None:
        if not getattr(self.effect, "timed", False):
            pytest.skip("does not depend on time")
        for model, channel, p in self._tried(cases):
            u = self._inputs(model, 5)
            before = [self.effect.input_sequence(u, model, channel, DT, p, start=start) for start in (-1e3, -5.0 * DT)]
            np.testing.assert_allclose(before[0], before[1], rtol=1e-9, atol=1e-12)

    # ------------------------------------------------------------ what it claims

    def test_only_the_channel_changes_and_only_by_what_it_reads(self, cases: list[Case]) -> None:
        self._only_on_inputs()
        for model, channel, p in self._tried(cases):
            if channel not in model.inputs:
                continue
            u, j = self._inputs(model, 40), model.inputs.index(channel)
            acting = self.effect.input_sequence(u, model, channel, DT, p)
            reads = self.effect.reads(model, channel) if hasattr(self.effect, "reads") else ()
            others = [i for i in range(len(model.inputs)) if i != j]
            assert (acting[:, others] == u[:, others]).all()
            unread = [i for i in others if model.inputs[i] not in reads]
            disturbed = u.copy()
            disturbed[:, unread] += 1.0
            assert (self.effect.input_sequence(disturbed, model, channel, DT, p)[:, j] == acting[:, j]).all()

    def test_what_it_claims_of_itself_is_true(self, cases: list[Case]) -> None:
        for model, channel, p in self._tried(cases):
            u = self._inputs(model, 100)
            if self.effect.stage == "input" and getattr(self.effect, "linear", False):
                assert linear_gap(self.effect, u, model, channel, DT, p) < 1e-9, "it is not linear"
            if self.effect.stage == "input" and getattr(self.effect, "shift", False):
                assert shift_gap(self.effect, np.repeat(u[::10], 40, axis=0), model, channel, DT, p) < 1e-9, "it is not a shift"
            if self.effect.stage == "input" and getattr(self.effect, "additive", False):
                assert additive_gap(self.effect, u, model, channel, DT, p) < 1e-9, "it is not the sum of what its parameters do"

    def test_neutral_parameters_are_no_effect(self, cases: list[Case]) -> None:
        named = {*getattr(self.effect, "named", ()), *getattr(self.effect, "choices", {})}
        neutral = {p.name: p.neutral for p in self.effect.parameters if p.name not in named}
        if not neutral or any(value is None for value in neutral.values()):
            pytest.skip("has no neutral value")
        for model, channel, p in self._tried(cases):
            x, u = self._states(model, 6), self._inputs(model, 10)[:6]
            at = {name: self._like(value, neutral[name]) if name in neutral else value for name, value in p.items()}
            expected = model.step(x, u, DT, model.parameters) if self.effect.stage == "step" else u if self.effect.stage == "input" else x
            np.testing.assert_allclose(self._step(model, channel, x, u, at), expected, rtol=1e-12, atol=1e-12)

    def test_it_does_something_on_each_of_its_channels(self, cases: list[Case]) -> None:
        """A force that no axis feels would be a name for nothing, and nobody would notice. Of channels that some of its values fit."""
        if self.effect.stage != "step":
            pytest.skip("does not act on a step")
        done: dict[tuple[str, str], bool] = {}
        for model, channel, p in self._tried(cases):
            x, u = self._states(model, 32), self._inputs(model, 40)[:32]
            without = model.step(x, u, DT, model.parameters)
            here = (model.name, channel)
            done[here] = done.get(here, False) or not np.allclose(self._step(model, channel, x, u, p), without, rtol=1e-12, atol=1e-12)
        idle = [f"{channel} of {model}" for (model, channel), does in done.items() if not does]
        assert not idle, f"it does nothing on {', '.join(idle)}"

    def test_parameters_have_units_and_bounds(self, cases: list[Case]) -> None:
        words = {*getattr(self.effect, "named", ()), *getattr(self.effect, "choices", {})}
        names = [p.name for p in self.effect.parameters]
        assert {*words, *getattr(self.effect, "optional", ())} <= set(names)
        for p in self.effect.parameters:
            assert p.name in words or p.low < p.high
            assert p.neutral is None or p.low <= p.neutral <= p.high
            for model, channel in cases:
                assert isinstance(self.effect.unit(model, channel, p.name), str)
        for _, _, values in self._tried(cases):
            for p in self.effect.parameters:
                value = values.get(p.name)
                if isinstance(value, float) and not math.isnan(value):
                    assert p.low <= value <= p.high
            assert not getattr(self.effect, "wrong", lambda p: "")(values)

    def test_the_tracer_gets_few_values_to_begin_from_and_all_are_allowed(self, cases: list[Case]) -> None:
        if not hasattr(self.effect, "starts"):
            pytest.skip("the tracer begins from a grid")
        for model, channel in cases:
            for u in (self._inputs(model, 100), np.abs(self._inputs(model, 100)), np.zeros((20, len(model.inputs)))):
                starts = self._starts(u, model, channel)
                assert len(starts) <= MOST_STARTS
                for p in starts:
                    self._allowed(p, model, channel)
                    if u.any():
                        assert self._step(model, channel, self._states(model, 2), u[:2], p).shape[0] == 2

    def test_what_it_sees_in_a_residual_is_allowed(self, cases: list[Case]) -> None:
        if not hasattr(self.effect, "starts_from_residual"):
            pytest.skip("looks at no residual")
        rng = np.random.default_rng(4)
        for model, channel in cases:
            for n in (0, 1, 7, 300):
                residual, t = rng.normal(size=(n, len(model.states))), DT * np.cumsum(rng.integers(1, 3, n))
                for pushes in (np.zeros_like(residual), np.full_like(residual, DT)):
                    for p in self.effect.starts_from_residual(residual, t, pushes, model, channel, DT):
                        self._allowed(p, model, channel)

    # ------------------------------------------------------------ in a model

    def test_it_composes_into_a_model_when_registered(self, cases: list[Case], tmp_path: Path) -> None:
        if self.effect.name not in registry().names("effects"):
            pytest.skip("not registered in this environment")
        for model, channel, p in self._tried(cases):
            if isinstance(model, Plain):
                continue
            spec = ModelSpec(model.name, DT, effects=(EffectSpec(self.effect.name, channel, p),))
            (tmp_path / "model.toml").write_text(dump_model(spec), encoding="utf-8")
            assert load_model(tmp_path / "model.toml") == spec
            composed = compose(spec)
            u = self._inputs(model, 20).repeat(3, axis=0).reshape(20, 3, -1) * np.array([1.0, -0.5, 0.0])[:, None]
            x, hidden = self._states(model, 3), composed.at_rest(3)
            alone = [(x[i : i + 1], composed.at_rest(1)) for i in range(3)]
            for row in u:
                x, hidden = composed.step(x, row, hidden)
                alone = [composed.step(a, row[i : i + 1], h) for i, (a, h) in enumerate(alone)]
            assert len(hidden) == 1
            assert hidden[0].shape[0] == 3
            np.testing.assert_allclose(x, np.concatenate([a for a, _ in alone]), rtol=1e-9, atol=1e-12)

    # ------------------------------------------------------------ how

    def _only_on_inputs(self) -> None:
        if self.effect.stage != "input":
            pytest.skip("does not act on inputs")

    def _tried(self, cases: list[Case]) -> Iterator[tuple[NominalModel, str, Values]]:
        """Every case with every set of values that it takes, names of inputs filled in. Fails if no set fits any case."""
        tried = 0
        for model, channel in cases:
            for given in (self.parameters, *self.others):
                other = {name: first_of(model, channel) for name in getattr(self.effect, "named", ()) if name in given}
                values = {**given, **other}
                if hasattr(self.effect, "takes"):
                    values = {name: value for name, value in values.items() if name in self.effect.takes(model, channel)}
                    if not values:  # these are for other channels
                        continue
                tried += 1
                yield model, channel, values
        assert tried, "none of the values fits any channel: they name no parameter that it takes there"

    def _takes(self, model: NominalModel, channel: str) -> set[str]:
        """Names of the parameters that it has there."""
        return {*takes(self.effect, model, channel)}

    def _like(self, value: object, number: float | None) -> object:
        """The number, in every entry if the value is a matrix."""
        return [[number for _ in row] for row in value] if isinstance(value, list) else number

    def _inputs(self, model: NominalModel, steps: int) -> Array:
        """Held values that change now and then, and a stretch of zeros."""
        rng = np.random.default_rng(1)
        u = np.repeat(rng.uniform(-1.0, 1.0, (steps // 5, len(model.inputs))), 5, axis=0)
        u[steps // 2 : steps // 2 + 5] = 0.0
        return u

    def _states(self, model: NominalModel, n: int) -> Array:
        return np.random.default_rng(2).uniform(-1.0, 1.0, (n, len(model.states)))

    def _stepped(self, u: Array, model: NominalModel, channel: str, p: Values, start: float = 0.0) -> Array:
        """u (T, nu) through `input_step`, a row after the other."""
        z = self.effect.hidden(1, model, channel, DT, p)
        if getattr(self.effect, "timed", False):
            assert z[0, 0] == 0.0, "column 0 of the hidden state must be the time, 0 at rest"
            z[:, 0] = start
        rows = []
        for row in u:
            acting, z = self.effect.input_step(row[None, :], z, model, channel, DT, p)
            rows.append(acting[0])
        return np.array(rows)

    def _starts(self, u: Array, model: NominalModel, channel: str) -> list[Values]:
        if getattr(self.effect, "timed", False):
            return list(self.effect.starts(u, model, channel, DT, DT * np.arange(len(u))))
        return list(self.effect.starts(u, model, channel, DT))

    def _allowed(self, p: Values, model: NominalModel, channel: str) -> None:
        """Known names, none left out that must be there, finite and inside the bounds."""
        takes = self._takes(model, channel)
        known = {q.name: q for q in self.effect.parameters if q.name in takes}
        assert set(known) - set(getattr(self.effect, "optional", ())) <= set(p) <= set(known)
        for name, value in p.items():
            if isinstance(value, float):
                assert known[name].low <= value <= known[name].high
            else:
                assert isinstance(value, str | list), f"{name} is {value!r}, must be a float, a word or a matrix"
        assert not getattr(self.effect, "wrong", lambda p: "")(p)

    def _step(self, model: NominalModel, channel: str, x: Array, u: Array, p: Values) -> Array:
        """One step: the input that acts, or the state after, or as it is measured."""
        effect: Effect = self.effect
        if effect.stage == "input":
            return effect.input_step(u, effect.hidden(len(u), model, channel, DT, p), model, channel, DT, p)[0]
        if effect.stage == "sensor":
            return effect.to_measured(x, model, channel, p)
        return effect.after_step(x, u, model.step(x, u, DT, model.parameters), model, channel, DT, p)
