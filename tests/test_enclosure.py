"""Tubes hold every disturbed run, a tube that is too small is noticed, and what is called enclosed is never unsafe."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import numpy as np
import pytest
from numpy.typing import NDArray

from s2r_runtime.controllers.code import batch_control
from s2r_runtime.controllers.file import load
from s2r_runtime.controllers.linear_feedback import gain_of
from s2r_runtime.errors import UsageError
from s2r_runtime.evidence.disturbance import GapSet
from s2r_runtime.evidence.enclosure import Tube, closed_loop, enclose, linear_tube, position_columns, rate_tube, tube_for
from s2r_runtime.evidence.uncertain import Control
from s2r_runtime.hookspecs import Scenario
from s2r_runtime.models.bound import wrap
from s2r_runtime.models.composed import ComposedModel, compose
from s2r_runtime.modelspec import EffectSpec, ModelSpec
from s2r_runtime.tasks.grid_world import GridWorld
from s2r_runtime.tasks.keep_out import KeepOut
from s2r_runtime.tasks.stl_task import StlTask

Array = NDArray[np.float64]

POINT = compose(ModelSpec("double_integrator", 0.1))
STEPS = 120
CONTROLLER = load(Path(__file__).parents[1] / "controllers" / "point_mass_keep_out.py", {"horizon": float(STEPS)})
TASK = KeepOut({"shift": 0.05, "steps": STEPS}, POINT.nominal, 0.1)
UNICYCLE = compose(ModelSpec("unicycle", 0.1))
ROLLOUTS = 10_000


def gap_set(kind: Literal["ball", "box"], radius: float = 0.001) -> GapSet:
    return GapSet(kind, (1.0, 1.0, 0.5, 0.5), radius, 5.0 * radius, 50)


def gain() -> Array:
    found = gain_of(CONTROLLER)
    assert found is not None
    return np.array(found)


def linear(gap: GapSet) -> Tube:
    return linear_tube(closed_loop(POINT, gain()), gap, [0, 1], STEPS)


def on_the_surface(gap: GapSet, directions: Array) -> Array:
    """The farthest points of D that way, (n, nx): of a box its corners."""
    if gap.kind == "box":
        return np.where(directions >= 0.0, 1.0, -1.0) * gap.radius / np.asarray(gap.weights)
    return gap.radius * directions / np.linalg.norm(directions, axis=1, keepdims=True) / np.asarray(gap.weights)


def disturbances(gap: GapSet, rng: np.random.Generator, n: int, matrix: Array, k: int) -> Array:
    """Of step k, (n, nx). A quarter each: uniform in D, on its surface, one point of its surface for the whole run, and the sequence
    that moves the last position farthest in one direction.
    """
    held = np.random.default_rng(77).normal(size=(n, matrix.shape[0]))
    power = np.linalg.matrix_power(matrix, STEPS - 1 - k)
    way = held[:, :2] @ power[:2]  # the adjoint of position, back to this step
    worst = way / np.asarray(gap.weights)
    found = gap.inside(rng, n, gap.radius)
    quarter = n // 4
    found[quarter : 2 * quarter] = on_the_surface(gap, rng.normal(size=(quarter, matrix.shape[0])))
    found[2 * quarter : 3 * quarter] = on_the_surface(gap, held[2 * quarter : 3 * quarter])
    found[3 * quarter :] = on_the_surface(gap, worst[3 * quarter :])
    return found


def excess(control: Control, model: ComposedModel, gap: GapSet, reach: Array, matrix: Array, task: KeepOut = TASK) -> float:
    """The largest share of the tube's reach that any of 10^4 disturbed runs ever used, over all steps."""
    rng = np.random.default_rng(5)
    scenario = task.draw(rng, ROLLOUTS)
    z = np.asfortranarray(scenario["start"])
    x = z.copy(order="F")
    most = 0.0
    hidden = model.at_rest(ROLLOUTS)
    for k in range(STEPS):
        view = task.view(scenario)
        z = np.asfortranarray(model.step(z, control(z, view), hidden)[0])
        drawn = disturbances(gap, rng, ROLLOUTS, matrix, k)
        assert np.all(gap.norm(drawn) <= gap.radius * (1.0 + 1e-9))
        x = np.asfortranarray(model.step(x, control(x, view), hidden)[0] + drawn)
        for column in model.angle_columns:
            x[:, column] = wrap(x[:, column])
        off = np.hypot(x[:, 0] - z[:, 0], x[:, 1] - z[:, 1])
        most = max(most, float(np.max(off)) / reach[k + 1])
        scenario = task.advance(scenario, rng)
    return most


@pytest.mark.parametrize("kind", ["ball", "box"])
def test_ten_thousand_disturbed_runs_stay_in_the_exact_tube_and_come_close_to_its_edge(kind: Literal["ball", "box"]) -> None:
    gap = gap_set(kind)
    used = excess(batch_control(CONTROLLER, 2), POINT, gap, linear(gap).reach, closed_loop(POINT, gain()))
    assert used <= 1.0 + 1e-9
    assert used > 0.95  # so a tube that is a twentieth too small is noticed


@pytest.mark.parametrize("kind", ["ball", "box"])
def test_a_tube_that_is_too_small_is_noticed_by_the_same_runs(kind: Literal["ball", "box"]) -> None:
    gap = gap_set(kind)
    used = excess(batch_control(CONTROLLER, 2), POINT, gap, 0.9 * linear(gap).reach, closed_loop(POINT, gain()))
    assert used > 1.0


def steer(x: Array, theta: Scenario) -> Array:
    """Turns back to the heading 0 on the spot."""
    u = np.zeros((len(x), 2))
    u[:, 1] = -2.0 * x[:, 2]
    return u


def test_ten_thousand_disturbed_runs_stay_in_the_tube_of_a_rate_that_is_true() -> None:
    """A unicycle that turns back on the spot: x and y stay, the heading shrinks, so the loop's rate is 1."""
    gap = GapSet("ball", (1.0, 1.0, 0.1), 0.001, 0.005, 50)
    task = KeepOut({"steps": STEPS}, UNICYCLE.nominal, 0.1)
    matrix = np.diag([1.0, 1.0, 0.8])
    tube = rate_tube(1.0, gap, [0, 1], STEPS)
    used = excess(steer, UNICYCLE, gap, tube.reach, matrix, task)
    assert 0.95 < used <= 1.0 + 1e-9
    assert excess(steer, UNICYCLE, gap, rate_tube(0.99, gap, [0, 1], STEPS).reach, matrix, task) > 1.0


def test_a_stated_rate_that_is_too_small_is_refuted_by_drawn_states_and_a_true_one_is_not() -> None:
    gap = GapSet("ball", (1.0, 1.0, 0.1), 0.0001, 0.005, 50)
    task = KeepOut({"steps": STEPS, "start_clearance": 0.1}, UNICYCLE.nominal, 0.1)
    for rate in (0.9, 1.0):
        found = enclose(steer, task, UNICYCLE, gap, rate_tube(rate, gap, [0, 1], STEPS), np.random.default_rng(1), 200)
        assert (found.rate_seen > rate * (1.0 + 1e-6)) == (rate < 1.0)

    def jumps(x: Array, theta: Scenario) -> Array:
        return np.where(x[:, :1] > theta["goal"][:, :1] - 0.5, 0.1, -0.1) * np.ones((1, 2))

    found = enclose(jumps, task, UNICYCLE, gap, rate_tube(1.0, gap, [0, 1], STEPS), np.random.default_rng(1), 500)
    assert found.rate_seen > 2.0


@pytest.mark.parametrize(("kind", "radius"), [("ball", 0.002), ("box", 0.001)])
def test_no_scenario_that_is_enclosed_is_ever_unsafe_and_some_that_are_not_are(kind: Literal["ball", "box"], radius: float) -> None:
    gap, n = gap_set(kind, radius), 2000
    control = batch_control(CONTROLLER, 2)
    found = enclose(control, TASK, POINT, gap, linear(gap), np.random.default_rng(9), n)
    assert 0 < found.failed < n
    unsafe = np.zeros(n, dtype=bool)
    for repeat in range(5):
        scenario = TASK.draw(_as_enclosed(9), n)
        rng = np.random.default_rng([repeat, 3])
        x = np.asfortranarray(scenario["start"])
        tally = TASK.observe(TASK.begin(scenario), x, scenario)
        toward = scenario["disc"] - scenario["start"][:, :2]
        for _ in range(STEPS):
            drawn = gap.inside(rng, n, gap.radius) if repeat == 0 else on_the_surface(gap, _push(rng, toward, repeat, n))
            x = np.asfortranarray(POINT.step(x, control(x, TASK.view(scenario)), ())[0] + drawn)
            toward = scenario["disc"] - x[:, :2]
            scenario = TASK.advance(scenario, rng)
            tally = TASK.observe(tally, x, scenario)
        unsafe |= TASK.safety(tally) < 0.0
    assert np.any(unsafe)
    assert not np.any(unsafe & found.enclosed)


def _as_enclosed(seed: int) -> np.random.Generator:
    """The generator as `enclose` leaves it to the draw of scenarios."""
    rng = np.random.default_rng(seed)
    rng.integers(1 << 63)
    return rng


def _push(rng: np.random.Generator, toward: Array, repeat: int, n: int) -> Array:
    """Towards the disc (with place and speed), away from it, or at random corners."""
    sign = {1: 1.0, 2: -1.0}.get(repeat, 0.0)
    return np.hstack([sign * toward, sign * toward]) + (1e-9 if sign else 1.0) * rng.normal(size=(n, 4))


def test_what_the_grid_task_calls_safe_within_a_distance_is_safe_everywhere_in_it() -> None:
    task = GridWorld({}, UNICYCLE.nominal, 0.1)
    rng = np.random.default_rng(3)
    scenario = task.draw(rng, 4000)
    x = np.zeros((4000, 3))
    x[:, 0], x[:, 1] = rng.uniform(-1.7, 1.7, 4000), rng.uniform(-1.1, 1.1, 4000)
    reach = 0.08
    safe, over = task.enclosed(x, reach, scenario, 0.0) or (x[:, 0] > 9.0,) * 2
    assert min(np.sum(safe), np.sum(over & safe)) > 50
    for k in range(60):
        angle, far = rng.uniform(-np.pi, np.pi, 4000), reach * (1.0 if k % 2 else np.sqrt(rng.random(4000)))
        moved = x.copy()
        moved[:, 0] += far * np.cos(angle)
        moved[:, 1] += far * np.sin(angle)
        tally = task.observe(task.begin(scenario), moved, scenario)
        assert not np.any(tally.crashed & safe)
        assert np.all((tally.crashed | tally.arrived)[over])
    assert task.enclosed(x, reach, scenario, 0.4) is None


def test_where_there_is_no_tube_the_reason_says_so() -> None:
    gap, unicycle = gap_set("ball"), GapSet("ball", (1.0, 1.0, 1.0), 0.001)
    stl = StlTask({"horizon": 1.0, "metric": "always (x < 1)", "progress": "none"}, POINT.nominal, 0.1)
    delayed = compose(ModelSpec("unicycle", 0.1, effects=(EffectSpec("input_delay", "*", {"delay": 0.1}),)))
    for call, words in (
        (lambda: tube_for(gain().tolist(), 0.0, stl, POINT, gap, 0.0), "does not say what is safe within a distance"),
        (lambda: tube_for(None, 0.0, TASK, POINT, gap, 0.0), "is not linear feedback by its source"),
        (lambda: tube_for(None, 1.0, GridWorld({}, UNICYCLE.nominal, 0.1), UNICYCLE, unicycle, 0.4), "verification.threshold = 0.4"),
        (lambda: tube_for(None, 1.0, GridWorld({}, delayed.nominal, 0.1), delayed, unicycle, 0.0), "effects with memory"),
    ):
        with pytest.raises(UsageError, match=words) as raised:
            call()
        assert "worst found, not proved" in str(raised.value)
    with pytest.raises(UsageError, match="is not linear, so feedback alone gives no tube"):
        closed_loop(UNICYCLE, np.zeros((2, 3)))
    with pytest.raises(UsageError, match=r"GAIN has shape \(1, 4\), must be \(2, 4\)"):
        closed_loop(POINT, np.zeros((1, 4)))
    with pytest.raises(UsageError, match="must be above 0 and finite"):
        rate_tube(0.0, gap, [0, 1], 3)
    assert position_columns(TASK, POINT) == [0, 1]


def test_a_rate_above_one_gives_a_tube_that_soon_encloses_nothing() -> None:
    gap = GapSet("ball", (1.0, 1.0, 0.1), 0.001)
    long = KeepOut({"steps": 5000}, UNICYCLE.nominal, 0.1)
    tube = rate_tube(1.5, gap, [0, 1], long.horizon)
    assert np.isinf(tube.reach[-1])
    assert enclose(steer, long, UNICYCLE, gap, tube, np.random.default_rng(1), 20).failed == 20


FORM = CONTROLLER.source.decode()


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("return feedforward - (x - target) @ np.array(GAIN).T", "return np.clip(feedforward - (x - target) @ np.array(GAIN).T, -1, 1)"),
        ("def reference(theta, parameters):", "def reference(theta, parameters, x=0):"),
        ("def reference(theta, parameters):", "import functools\n@functools.lru_cache\ndef reference(theta, parameters):"),
        ("    p = parameters\n", "    global GAIN\n    p = parameters\n"),
        ("    p = parameters\n", "    GAIN = 3\n    p = parameters\n"),
        ("import numpy as np\n", "import math as np\n"),
        ("import numpy as np\n", "import numpy as np\nfrom math import *\n"),
        ("GAIN = [[1.0,", "GAIN = [[float(1),"),
        ("GAIN = [[", "GAIN = None\nGAIN = [["),
        ("0.0, 2.0]]", "0.0]]"),
        ("    target, feedforward = reference(theta, parameters)\n", "    target, feedforward = reference(theta, x)\n"),
    ],
)
def test_another_form_of_the_controller_is_not_taken_for_linear_feedback(old: str, new: str, tmp_path: Path) -> None:
    assert gain_of(CONTROLLER) == ((1.0, 0.0, 2.0, 0.0), (0.0, 1.0, 0.0, 2.0))
    assert old in FORM
    path = tmp_path / "other.py"
    path.write_text(FORM.replace(old, new, 1))
    assert gain_of(load(path)) is None


def test_the_form_is_what_the_controller_does() -> None:
    """u(x) - u(z) = -K (x - z) in drawn states of drawn scenarios."""
    rng = np.random.default_rng(2)
    control, scenario = batch_control(CONTROLLER, 2), TASK.draw(rng, 500)
    x, z = rng.normal(size=(2, 500, 4))
    apart = control(x, TASK.view(scenario)) - control(z, TASK.view(scenario))
    assert apart == pytest.approx(-(x - z) @ gain().T)
