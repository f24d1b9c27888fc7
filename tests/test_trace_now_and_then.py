"""Commands that are lost in single steps, and shocks that stay: outliers that are no matter of a sensor."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from seeds import first

from s2r_runtime.models.composed import AppliedEffect, ComposedModel, compose
from s2r_runtime.modelspec import EffectSpec, ModelSpec
from s2r_runtime.plugins import registry
from s2r_runtime.trace.dataset import Dataset, from_arrays
from s2r_runtime.trace.fitting import evaluate, fitted, insert, problem
from s2r_runtime.trace.lack_of_fit import left_of
from s2r_runtime.trace.now_and_then import now_and_then
from s2r_runtime.trace.residual import steps_of
from s2r_runtime.trace.tracer import trace

Array = NDArray[np.float64]

DT, PARTS, ROWS = 0.05, 20, 1200
CART = compose(ModelSpec("unicycle", DT, {}, (EffectSpec("integration_scheme", "*", {"scheme": "exact"}),)))
JOINT = compose(ModelSpec("joint", 0.02, {"mass": 0.5}))
DRAG = EffectSpec("viscous_friction", "qd", {"coefficient": 0.4})


def _driven(seed: int, late: Array, before: int = 1) -> Dataset:
    """A cart on arcs with a command in every row. late: (ROWS,) of each step, the share in which the command before still acts."""
    rng = np.random.default_rng(seed)
    u = np.zeros((ROWS, 2))
    for k in range(1, ROWS):
        u[k] = 0.9 * u[k - 1] + rng.normal(size=2) * [0.1, 0.3]
    u[:, 0] += 0.6
    x, rows = np.zeros(3), [np.zeros(3)]
    for k in range(ROWS):
        for part in range(PARTS):
            v, w = u[max(k - before, 0)] if (part + 0.5) / PARTS < late[k] else u[k]
            x = x + DT / PARTS * np.array([v * math.cos(x[2]), v * math.sin(x[2]), w])
        rows.append(x)
    return from_arrays(CART, [(np.array(rows) + rng.normal(size=(ROWS + 1, 3)) * [8e-4, 8e-4, 2e-3], u)])


def _pushed(seed: int, share: float, *effects: EffectSpec, nothing: bool = False, hit: float = 0.0) -> Dataset:
    """A joint with a force in every row, a share of which is lost: that before goes on, or nothing acts. hit: m/s, of shocks that take its
    speed along in as many steps instead.
    """
    rng, robot = np.random.default_rng(seed), compose(ModelSpec("joint", 0.02, {"mass": 0.5}, effects))
    u, lost = rng.uniform(-2.0, 2.0, (ROWS, 1)), rng.random(ROWS) < share
    acts, x, rows = np.zeros(1), np.zeros((1, 2)), [np.zeros(2)]
    for k in range(ROWS):
        acts = acts if lost[k] and not hit else u[k]
        x, _ = robot.step(x, (0.0 * acts if nothing and lost[k] else acts)[None], robot.at_rest(1))
        x[0, 1] += hit * rng.normal() * lost[k]
        rows.append(x[0])
    return from_arrays(JOINT, [(np.array(rows) + rng.normal(size=(ROWS + 1, 2)) * [2e-4, 4e-3], u)])


def _lost(data: Dataset, model: ComposedModel) -> tuple[str, ...]:
    given = problem(data, steps_of(data))
    found = now_and_then(left_of(given, evaluate(given, model)))
    return () if found is None else found.tokens


@pytest.mark.parametrize("every", [6, 20])
@pytest.mark.parametrize("seed", first(1, range(3)))
def test_commands_that_are_lost_are_no_delay_and_no_play_and_not_nothing(every: int, seed: int) -> None:
    """In every sixth step, a mean over all is a delay of a sixth of a step; in every twentieth, single rows are off."""
    data = _driven(seed, np.where(np.arange(ROWS) % every == 0, 1.0, 0.0))
    found = trace(data, CART)
    assert (found.verdict, found.effects) == ("unexplained", ())
    assert {*found.depends_on} == {"memory(v)", "memory(w)"}
    assert {*_lost(data, CART)} == {"memory(v)", "memory(w)"}


@pytest.mark.parametrize("seed", first(1, range(3)))
def test_commands_in_the_place_of_which_nothing_acts_are_no_weaker_input(seed: int) -> None:
    found = trace(_pushed(seed, 0.25, nothing=True), JOINT)
    assert (found.verdict, found.effects, found.depends_on) == ("unexplained", (), ("force",))


@pytest.mark.parametrize("nothing", [False, True])
def test_an_effect_keeps_its_name_beside_commands_that_are_lost_and_these_are_told(nothing: bool) -> None:
    found = trace(_pushed(1, 0.02, DRAG, nothing=nothing), JOINT)
    assert [(e.name, e.channel) for e in found.effects] == [("viscous_friction", "qd")]
    assert found.effects[0].values == {"coefficient": pytest.approx(0.4, rel=0.05)}
    assert found.depends_on[0] == found.may_depend_on[0] == ("force" if nothing else "memory(force)")


def test_commands_that_come_late_within_their_steps_are_a_delay_on_average() -> None:
    late = np.random.default_rng(7).uniform(0.0, 1.0, ROWS)
    data = _driven(1, late)
    assert _lost(data, CART) == ()
    found = trace(data, CART)
    assert [(e.name, e.channel) for e in found.effects] == [("input_delay", "*")]
    assert found.effects[0].values == {"delay": pytest.approx(0.5 * DT, rel=0.1)}


def test_an_input_that_never_changes_may_be_lost_too() -> None:
    """There is no command before that would be another one."""
    rng, x, rows = np.random.default_rng(3), np.zeros(3), [np.zeros(3)]
    w, lost = rng.uniform(-1.0, 1.0, ROWS), rng.random(ROWS) < 0.05
    robot = CART
    for k in range(ROWS):
        x = robot.step(x[None], np.array([[0.0 if lost[k] else 0.6, w[k]]]), robot.at_rest(1))[0][0]
        rows.append(x)
    u = np.column_stack([np.full(ROWS, 0.6), w])
    data = from_arrays(CART, [(np.array(rows) + rng.normal(size=(ROWS + 1, 3)) * [8e-4, 8e-4, 2e-3], u)])
    assert _lost(data, CART) == ("v",)


def test_a_model_of_ones_own_that_knows_no_zero_command_is_not_asked_about_it(tmp_path: Path) -> None:
    (tmp_path / "pump.py").write_text(
        'STATES = ("level",)\nINPUTS = ("flow",)\nPARAMS = {}\n\n\ndef step(x, u, dt, params):\n'
        '    if (u <= 0.0).any():\n        raise ValueError("no flow")\n    return x + 0.1 * dt * u\n'
    )
    model = compose(ModelSpec(str(tmp_path / "pump.py"), 0.5))
    rng = np.random.default_rng(5)
    u = rng.uniform(1.0, 2.0, (400, 1))
    level = np.concatenate([[[0.0]], np.cumsum(0.05 * u, axis=0)]) + rng.normal(size=(401, 1)) * 1e-3
    assert _lost(from_arrays(model, [(level, u)]), model) == ()


@pytest.mark.parametrize("seed", first(2, range(20)))
def test_outliers_of_a_sensor_know_nothing_of_commands(seed: int) -> None:
    """A twentieth of the rows, as far off as a command takes the cart in a step."""
    data = _driven(seed, np.zeros(ROWS))
    (run,) = data.runs
    rng = np.random.default_rng(100 + seed)
    run.y[rng.random(ROWS + 1) < 0.05] += [0.01, 0.01, 0.02]
    assert _lost(data, CART) == ()


@pytest.mark.parametrize("share", [0.06, 0.1, 0.15])
@pytest.mark.parametrize("seed", first(2, range(6)))
def test_rows_that_are_one_sample_old_are_no_commands_that_are_lost(seed: int, share: float) -> None:
    """Where they are, the robot seems not to have moved: just what no command does, but in the next row it is where it should be."""
    data = _driven(seed, np.zeros(ROWS))
    (run,) = data.runs
    old = np.append(False, np.random.default_rng(200 + seed).random(ROWS) < share)
    run.y[old] = run.y[np.flatnonzero(old) - 1] + np.random.default_rng(300 + seed).normal(size=(np.count_nonzero(old), 3)) * [
        8e-4,
        8e-4,
        2e-3,
    ]
    found = trace(data, CART)
    assert (found.verdict in {"none", "sensor_fault"}, {*found.depends_on} - {"noise"}) == (True, set())


@pytest.mark.parametrize("seed", first(2, range(20)))
def test_shocks_that_stay_make_no_other_drag_likelier(seed: int) -> None:
    """A joint that is hit in every fiftieth step goes on at another speed. A filter that does not believe it is off for long, by the right
    drag most of all, which leaves the least noise otherwise.
    """
    data = _pushed(seed, 0.02, DRAG, hit=0.08)
    given, model = problem(data, steps_of(data)), JOINT
    base = evaluate(given, model)
    right, wrong = (
        fitted(given, base, insert(model, AppliedEffect(registry().get("effects", name), "qd", {"coefficient": 0.4}), 0))
        for name in ("viscous_friction", "quadratic_drag")
    )
    assert right.white > wrong.white
    assert right.model.effects[0].p["coefficient"] == pytest.approx(0.4, rel=0.1)
