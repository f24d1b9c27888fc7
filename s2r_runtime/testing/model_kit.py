"""What the runtime relies on in a model (hookspecs.NominalModel): one batched step that depends on its arguments only.

x: (n, nx), u: (n, nu); what is checked for rows and angles is what rollouts, discrepancies and the tracer take for granted.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
from numpy.typing import NDArray

from s2r_runtime.models.composed import compose
from s2r_runtime.modelspec import ModelSpec, dump_model, load_model
from s2r_runtime.plugins import registry

Array = NDArray[np.float64]


class ModelKit:
    """Subclass with `model`. dt: a step that makes sense, s. states, inputs: how far from 0 to try each, in SI units."""

    model: ClassVar[Any]
    dt: ClassVar[float] = 0.05
    states: ClassVar[float] = 1.0
    inputs: ClassVar[float] = 1.0

    # ------------------------------------------------------------ what it says of itself

    def test_names_are_text_and_differ(self) -> None:
        assert isinstance(self.model.name, str)
        assert self.model.name
        for names in (self.model.states, self.model.inputs, self.model.angles):
            assert isinstance(names, tuple), "names must stand in a tuple: their order is that of the columns"
            assert all(isinstance(name, str) and name.isidentifier() for name in names)
        everything = self.model.states + self.model.inputs
        assert len(set(everything)) == len(everything), "a name stands for two columns"
        assert self.model.states
        assert self.model.inputs

    def test_angles_are_states(self) -> None:
        assert set(self.model.angles) <= set(self.model.states)

    def test_parameters_have_finite_defaults(self) -> None:
        for name, value in self.model.parameters.items():
            assert isinstance(name, str)
            assert isinstance(value, float), f"{name} is {value!r}, must be a float"
            assert math.isfinite(value)

    def test_what_it_may_also_say_is_about_its_own_columns(self) -> None:
        columns = {*self.model.states, *self.model.inputs}
        assert set(getattr(self.model, "units", {})) <= columns
        reached = getattr(self.model, "reached", {})
        assert set(reached) <= set(self.model.states)
        assert set(reached.values()) <= set(self.model.inputs)
        for state, how in getattr(self.model, "follows", {}).items():
            assert state in self.model.states
            assert set(how.of) <= set(self.model.states)
            assert callable(how.formula)
        if getattr(self.model, "integration", "euler") == "euler" and hasattr(self.model, "integration"):
            assert {"x", "y", "theta"} <= set(self.model.states), "integration is for planar poses"

    # ------------------------------------------------------------ the step

    def test_step_gives_one_finite_row_for_each(self) -> None:
        for n in (1, 2, 50):
            x, u = self._rows(n)
            after = self._step(x, u)
            assert isinstance(after, np.ndarray)
            assert after.shape == x.shape
            assert after.dtype == np.float64
            assert np.isfinite(after).all()

    def test_rows_do_not_mix(self) -> None:
        x, u = self._rows(20)
        together = self._step(x, u)
        for i in range(20):
            np.testing.assert_allclose(self._step(x[i : i + 1], u[i : i + 1])[0], together[i], rtol=1e-12, atol=1e-15)

    def test_arguments_are_not_changed(self) -> None:
        x, u = self._rows(5)
        p = dict(self.model.parameters)
        given = x.copy(), u.copy(), dict(p)
        after = self.model.step(x, u, self.dt, p)
        assert after is not x
        assert (x == given[0]).all()
        assert (u == given[1]).all()
        assert p == given[2]

    def test_same_arguments_give_the_same_step(self) -> None:
        x, u = self._rows(20)
        first = self._step(x, u)
        self._step(*self._rows(7))
        assert (self._step(x, u) == first).all(), "the step remembers something"

    def test_a_full_turn_more_of_an_angle_is_the_same_robot(self) -> None:
        x, u = self._rows(20)
        here = self._step(x, u)
        for name in self.model.angles:
            column = self.model.states.index(name)
            turned, expected = x.copy(), here.copy()
            turned[:, column] += 2.0 * math.pi
            after = self._step(turned, u)
            expected[:, column] += 2.0 * math.pi
            after[:, column] -= 2.0 * math.pi * np.rint((after[:, column] - expected[:, column]) / (2.0 * math.pi))
            np.testing.assert_allclose(after, expected, rtol=1e-9, atol=1e-9)

    def test_a_shorter_step_goes_less_far(self) -> None:
        """As dt goes to 0, the state stays: nothing but what `reached` names jumps to its input at once."""
        x, u = self._rows(20)
        jumps = [self.model.states.index(name) for name in getattr(self.model, "reached", {})]
        stays = [j for j in range(x.shape[1]) if j not in jumps]
        moved = np.abs(self.model.step(x, u, self.dt, dict(self.model.parameters)) - x)[:, stays]
        little = np.abs(self.model.step(x, u, self.dt * 1e-4, dict(self.model.parameters)) - x)[:, stays]
        assert (little <= 1e-2 * (moved + self.states + self.inputs)).all()

    # ------------------------------------------------------------ in the runtime

    def test_it_composes_and_survives_its_file_when_registered(self, tmp_path: Path) -> None:
        if self.model.name not in registry().names("models"):
            pytest.skip("not registered in this environment")
        spec = ModelSpec(self.model.name, self.dt, parameters=dict(self.model.parameters))
        (tmp_path / "model.toml").write_text(dump_model(spec), encoding="utf-8")
        assert load_model(tmp_path / "model.toml") == spec
        composed = compose(spec)
        x, u = self._rows(3)
        after, _ = composed.step(x, u, composed.at_rest(3))
        np.testing.assert_allclose(after, self._step(x, u), rtol=1e-12, atol=1e-12)

    # ------------------------------------------------------------ how

    def _rows(self, n: int) -> tuple[Array, Array]:
        rng = np.random.default_rng(n)
        x = rng.uniform(-self.states, self.states, (n, len(self.model.states)))
        return x, rng.uniform(-self.inputs, self.inputs, (n, len(self.model.inputs)))

    def _step(self, x: Array, u: Array) -> Array:
        after: Array = self.model.step(x, u, self.dt, dict(self.model.parameters))
        return after
