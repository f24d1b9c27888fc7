"""The go-to laws bring a robot to its waypoint from anywhere, also one whose actuators are worse than it believes."""

from __future__ import annotations

import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from s2r_runtime.core.goto import Gains, distance, go_to, supported
from s2r_runtime.errors import ConfigError

DT = 0.033
BOUNDS = ((-0.2, 0.2), (-math.pi, math.pi))
TRACK, WHEEL = 0.105, 0.2
pose = st.tuples(st.floats(-1.6, 1.6), st.floats(-1.0, 1.0), st.floats(-math.pi, math.pi))
point = st.tuples(st.floats(-1.45, 1.45), st.floats(-0.85, 0.85))


def unicycle(x: tuple[float, ...], u: tuple[float, ...]) -> tuple[float, ...]:
    return (x[0] + DT * u[0] * math.cos(x[2]), x[1] + DT * u[0] * math.sin(x[2]), x[2] + DT * u[1])


def clipped(u: tuple[float, ...]) -> tuple[float, float]:
    right, left = (min(max(u[0] + sign * 0.5 * TRACK * u[1], -WHEEL), WHEEL) for sign in (1, -1))
    return 0.5 * (right + left), (right - left) / TRACK


def steps_until(x: tuple[float, ...], target: tuple[float, ...], radius: float, delay: int, gains: Gains) -> int:
    """Periods until the robot, with wheel clipping and a delayed command, is within the radius; the bound if it never is."""
    waiting = [(0.0, 0.0)] * delay
    for k in range(1500):
        if distance("unicycle", x, target) <= radius:
            return k
        waiting.append(clipped(go_to("unicycle", x, target, BOUNDS, gains)))
        x = unicycle(x, waiting.pop(0))
    return 1500


@given(x=pose, target=point, delay=st.integers(0, 3))
@settings(max_examples=150, deadline=None, derandomize=True)
def test_unicycle_arrives_from_anywhere_with_clipped_wheels_and_latency(
    x: tuple[float, ...], target: tuple[float, ...], delay: int
) -> None:
    # the region's diagonal at full speed, half a turn on the spot, and the law's last exponential metre: under 1000 periods
    assert steps_until(x, target, 0.1, delay, Gains()) < 1000


@given(x=pose, target=point)
@settings(max_examples=100, deadline=None, derandomize=True)
def test_lyapunov_function_never_rises_beyond_what_one_period_discretises(x: tuple[float, ...], target: tuple[float, ...]) -> None:
    def value(x: tuple[float, ...]) -> float:
        rho = distance("unicycle", x, target)
        alpha = math.remainder(math.atan2(target[1] - x[1], target[0] - x[0]) - x[2], math.pi)  # forward or backward alike
        return 0.5 * rho * rho + 0.5 * alpha * alpha

    for _ in range(300):
        if distance("unicycle", x, target) < 0.1:
            break
        before, u = value(x), go_to("unicycle", x, target, BOUNDS, Gains())
        x = unicycle(x, u)
        # second order of one Euler step: at most (dt w)^2/2 from alpha and (dt v)^2 (1 + 1/rho^2) from the bearing
        rho = max(distance("unicycle", x, target), 0.09)
        assert value(x) <= before + 0.5 * (DT * u[1]) ** 2 + (DT * u[0]) ** 2 * (1.0 + math.pi / rho**2) + 1e-12


@given(x=pose, target=point, low=st.floats(-0.3, 0.0), high=st.floats(0.05, 0.3), turn=st.floats(0.1, 4.0))
@settings(max_examples=200, deadline=None, derandomize=True)
def test_input_stays_inside_its_bounds(x: tuple[float, ...], target: tuple[float, ...], low: float, high: float, turn: float) -> None:
    for name, state in (("unicycle", x), ("differential_drive", (*x, 0.0, 0.0)), ("double_integrator", (*x, 0.1))):
        bounds = ((low, high), (-turn, turn))
        u = go_to(name, state, target, bounds, Gains())
        assert all(lower <= value <= upper for value, (lower, upper) in zip(u, bounds, strict=True))


def test_turn_bound_slows_the_robot_down_rather_than_make_it_orbit() -> None:
    x, target = (0.0, 0.0, 0.0), (0.0, 0.3)  # beside it: closer than the circle of full speed and a tight turn bound
    bounds = ((-0.2, 0.2), (-0.3, 0.3))
    for _ in range(3000):
        x = unicycle(x, go_to("unicycle", x, target, bounds, Gains()))
    assert distance("unicycle", x, target) < 0.01


def test_robot_that_cannot_reverse_turns_round() -> None:
    x, target, bounds = (0.0, 0.0, 0.0), (-0.5, 0.0), ((0.0, 0.2), (-1.0, 1.0))
    for _ in range(800):
        u = go_to("unicycle", x, target, bounds, Gains())
        assert u[0] >= 0.0
        x = unicycle(x, u)
    assert distance("unicycle", x, target) < 0.05


def test_goal_behind_is_reached_backward_without_turning() -> None:
    v, w = go_to("unicycle", (0.0, 0.0, 0.0), (-1.0, 0.0), BOUNDS, Gains())
    assert v == pytest.approx(-0.2)
    assert w == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize("track", [0.05, 0.2, 0.8])
def test_differential_drive_arrives_though_its_track_is_not_known_well(track: float) -> None:
    radius, bounds = 0.05, ((-10.0, 10.0), (-10.0, 10.0))
    for start in ((0.0, 0.0, 2.0), (1.0, 0.5, -1.0), (-1.0, 0.7, 0.1)):
        x, target = (*start, 0.0, 0.0), (0.6, -0.4)
        for _ in range(600):
            left, right = go_to("differential_drive", x, target, bounds, Gains(wheel_radius=radius, track=0.2))
            x = (*unicycle(x, (0.5 * radius * (left + right), radius * (right - left) / track)), left, right)
        assert distance("differential_drive", x, target) < 0.1


def test_double_integrator_arrives_and_stops() -> None:
    x, target, bounds = (1.0, -0.8, 0.5, -0.5), (-1.0, 0.9), ((-0.3, 0.3), (-0.3, 0.3))
    for _ in range(1500):
        ax, ay = go_to("double_integrator", x, target, bounds, Gains())
        x = (x[0] + DT * x[2] + 0.5 * DT * DT * ax, x[1] + DT * x[3] + 0.5 * DT * DT * ay, x[2] + DT * ax, x[3] + DT * ay)
    assert distance("double_integrator", x, target) < 1e-3


def test_passing_a_goal_at_speed_is_not_arriving() -> None:
    assert distance("double_integrator", (0.0, 0.0, 0.5, 0.0), (0.0, 0.0)) == pytest.approx(0.5)


def test_input_at_the_goal_is_zero() -> None:
    assert go_to("unicycle", (0.3, 0.2, 1.0), (0.3, 0.2), BOUNDS, Gains()) == (0.0, 0.0)


def test_model_without_a_law_is_refused_with_those_that_have_one() -> None:
    assert supported("unicycle")
    assert not supported("joint")
    with pytest.raises(ConfigError, match="'joint' has no go-to law; there is one for: differential_drive, double_integrator, unicycle"):
        go_to("joint", (0.0, 0.0), (1.0,), ((-1.0, 1.0),), Gains())
