"""What the runtime relies on in an effect (hookspecs.Effect): that it is the same thing step by step and over time."""

from __future__ import annotations

import math
from typing import Any, ClassVar

import numpy as np
import pytest
from numpy.typing import NDArray

from s2r_runtime.hookspecs import Effect, NominalModel
from s2r_runtime.models.composed import compose
from s2r_runtime.modelspec import EffectSpec, ModelSpec
from s2r_runtime.plugins import registry

DT = 0.033


class EffectKit:
    """Subclass with `effect` and `parameters` (values at which it does something). models: those on which to try it; default: all
    registered ones on which it has a channel.
    """

    effect: ClassVar[Any]
    parameters: ClassVar[dict[str, Any]]
    models: ClassVar[tuple[str, ...]] = ()

    @pytest.fixture
    def cases(self) -> list[tuple[NominalModel, str]]:
        """(model, channel) for every channel of every model."""
        names = self.models or tuple(registry().names("models"))
        found = [(model, channel) for model in (registry().get("models", n) for n in names) for channel in self.effect.channels(model)]
        assert found, "the effect has no channel on any of these models"
        return found

    def _inputs(self, model: NominalModel, steps: int) -> NDArray[np.float64]:
        """Held values that change now and then, and a stretch of zeros."""
        rng = np.random.default_rng(1)
        u = np.repeat(rng.uniform(-1.0, 1.0, (steps // 5, len(model.inputs))), 5, axis=0)
        u[steps // 2 : steps // 2 + 5] = 0.0
        return u

    def _states(self, model: NominalModel, n: int) -> NDArray[np.float64]:
        return np.random.default_rng(2).uniform(-1.0, 1.0, (n, len(model.states)))

    def test_over_time_at_once_is_the_same_as_step_by_step(self, cases: list[tuple[NominalModel, str]]) -> None:
        if self.effect.stage != "input":
            pytest.skip("acts on the step")
        for model, channel in cases:
            u = self._inputs(model, 100)
            z = self.effect.hidden(1, model, channel, DT, self.parameters)
            stepped = []
            for row in u:
                acting, z = self.effect.input_step(row[None, :], z, model, channel, DT, self.parameters)
                stepped.append(acting[0])
            at_once = self.effect.input_sequence(u, model, channel, DT, self.parameters)
            assert at_once.shape == u.shape
            np.testing.assert_allclose(at_once, np.array(stepped), rtol=1e-9, atol=1e-12)

    def test_rows_do_not_mix_and_shapes_stay(self, cases: list[tuple[NominalModel, str]]) -> None:
        for model, channel in cases:
            x, u = self._states(model, 7), self._inputs(model, 10)[:7]
            one = self._step(model, channel, x, u)
            assert one.shape == (x if self.effect.stage == "step" else u).shape
            assert np.isfinite(one).all()
            for i in range(7):
                np.testing.assert_allclose(one[i], self._step(model, channel, x[i : i + 1], u[i : i + 1])[0], rtol=1e-12, atol=1e-15)

    def test_arguments_are_not_changed(self, cases: list[tuple[NominalModel, str]]) -> None:
        for model, channel in cases:
            x, u = self._states(model, 4), self._inputs(model, 10)[:4]
            given = x.copy(), u.copy()
            self._step(model, channel, x, u)
            assert (x == given[0]).all()
            assert (u == given[1]).all()

    def test_neutral_parameters_are_no_effect(self, cases: list[tuple[NominalModel, str]]) -> None:
        neutral = {p.name: p.neutral for p in self.effect.parameters}
        if not neutral or any(value is None for value in neutral.values()):
            pytest.skip("has no neutral value")
        for model, channel in cases:
            x, u = self._states(model, 6), self._inputs(model, 10)[:6]
            expected = model.step(x, u, DT, model.parameters) if self.effect.stage == "step" else u
            np.testing.assert_allclose(self._step(model, channel, x, u, {**self.parameters, **neutral}), expected, rtol=1e-12, atol=1e-12)

    def test_parameters_have_units_and_bounds(self, cases: list[tuple[NominalModel, str]]) -> None:
        for p in self.effect.parameters:
            assert p.low < p.high
            assert p.neutral is None or p.low <= p.neutral <= p.high
            for model, channel in cases:
                assert isinstance(self.effect.unit(model, channel, p.name), str)
            value = self.parameters.get(p.name)
            if isinstance(value, float) and not math.isnan(value):
                assert p.low <= value <= p.high

    def test_it_composes_into_a_model_when_registered(self, cases: list[tuple[NominalModel, str]]) -> None:
        if self.effect.name not in registry().names("effects"):
            pytest.skip("not registered in this environment")
        for model, channel in cases:
            composed = compose(ModelSpec(model.name, DT, effects=(EffectSpec(self.effect.name, channel, self.parameters),)))
            x, hidden = composed.step(self._states(model, 3), self._inputs(model, 10)[:3], composed.at_rest(3))
            assert x.shape == (3, len(model.states))
            assert len(hidden) == 1

    def _step(
        self, model: NominalModel, channel: str, x: NDArray[np.float64], u: NDArray[np.float64], p: dict[str, Any] | None = None
    ) -> NDArray[np.float64]:
        """One step: the input that acts, or the state after."""
        effect: Effect = self.effect
        values = self.parameters if p is None else p
        if effect.stage == "input":
            acting, _ = effect.input_step(u, effect.hidden(len(u), model, channel, DT, values), model, channel, DT, values)
            return acting
        return effect.after_step(x, u, model.step(x, u, DT, model.parameters), model, channel, DT, values)
