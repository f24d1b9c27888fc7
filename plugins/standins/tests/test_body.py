"""The stand-in is the robot that its data sheet describes, and what is wrong with it is what it was told."""

from __future__ import annotations

import itertools
import math
import statistics
import subprocess
import sys

import pytest
from s2r_standins.body import Body, DataSheet

from s2r_runtime.errors import ConfigError

QUIET = DataSheet(sigma_position=0.0, sigma_heading=0.0, latency=0)


def body(sheet: DataSheet = QUIET, start: tuple[float, float, float] = (0.0, 0.0, 0.0), seed: int = 1) -> Body:
    return Body(sheet, start, seed)


def held(b: Body, v: float, w: float, periods: int) -> tuple[float, float, float]:
    for _ in range(periods):
        b.move((v, w))
    return b.pose


@pytest.mark.parametrize("latency", [0, 1, 2])
def test_command_acts_as_many_periods_late_as_the_latency_says(latency: int) -> None:
    b = body(QUIET._replace(latency=latency))
    b.move((0.1, 0.0))
    moved = [b.pose[0]]
    for _ in range(3):
        b.move((0.0, 0.0))
        moved.append(b.pose[0])
    expected = [0.0 if k < latency else 0.0033 for k in range(4)]
    assert moved == pytest.approx(expected)


def test_wheels_are_clipped_which_couples_speed_and_turn() -> None:
    x, _, theta = held(body(), 0.2, 3.0, 1)
    v, w = 0.5 * (0.2 + 0.0425), (0.2 - 0.0425) / 0.105  # right wheel .3575 clipped to .2, left .0425
    assert theta == pytest.approx(0.033 * w)
    assert x == pytest.approx(0.033 * v, rel=1e-3)


def test_exact_motion_closes_a_circle_and_euler_does_not() -> None:
    periods = 200
    w = 2.0 * math.pi / (periods * 0.033)
    exact = held(body(), 0.1, w, periods)
    euler = held(body(QUIET._replace(integration="euler")), 0.1, w, periods)
    assert math.hypot(exact[0], exact[1]) < 1e-9
    # Euler walks a regular polygon of the same number of sides: it closes too, but its first step goes along the tangent
    assert held(body(QUIET._replace(integration="euler")), 0.1, w, 1)[1] == 0.0
    assert held(body(), 0.1, w, 1)[1] > 0.0
    assert math.hypot(euler[0], euler[1]) < 1e-9


def test_noise_has_the_sigmas_of_the_data_sheet() -> None:
    """4000 values: a standard deviation within 4.5 % but for 6e-5 of seeds (normal, relative error 1/sqrt(2n) = 1.1 %, 4 sigma)."""
    b = body(DataSheet())
    values = [b.observe() for _ in range(4000)]
    for i, sigma in enumerate((0.0002, 0.0002, 0.001)):
        column = [value[i] for value in values]
        assert statistics.pstdev(column) == pytest.approx(sigma, rel=0.045)
        assert abs(statistics.fmean(column)) < 4.0 * sigma / math.sqrt(4000)


def test_one_seed_gives_one_robot() -> None:
    runs = []
    for seed in (1, 1, 2):
        b = body(DataSheet(), seed=seed)
        run = []
        for k in range(50):
            run.append(b.observe())
            b.move((0.1, math.sin(k)))
        runs.append(run)
    assert runs[0] == runs[1] != runs[2]


def test_wall_stops_the_robot_and_heading_stays_wrapped() -> None:
    b = body(QUIET._replace(walls=(0.5, 0.4)))
    assert held(b, 0.2, 0.0, 200)[0] == 0.5
    b = body()
    for _ in range(300):
        b.move((0.0, 3.0))
        assert -math.pi < b.pose[2] <= math.pi


def test_effect_of_the_library_acts_and_ends() -> None:
    b = body()
    b.switch_on("input_gain:w gain=0.5")
    assert held(b, 0.0, 1.0, 10)[2] == pytest.approx(10 * 0.033 * 0.5)
    b.switch_on("input_gain:w gain=0.25")  # replaces the one before
    before = b.pose[2]
    assert held(b, 0.0, 1.0, 10)[2] - before == pytest.approx(10 * 0.033 * 0.25)
    b.switch_on("input_gain:v gain=0.0")  # comes on top
    b.clear()
    before = b.pose
    after = held(b, 0.1, 1.0, 1)
    assert after[2] - before[2] == pytest.approx(0.033)
    assert math.hypot(after[0] - before[0], after[1] - before[1]) == pytest.approx(0.0033, rel=1e-3)


def test_effect_with_memory_begins_at_rest_when_it_is_switched_on() -> None:
    b = body()
    held(b, 0.1, 0.0, 10)
    b.switch_on("input_delay:v delay=0.066")
    before = b.pose[0]
    assert held(b, 0.1, 0.0, 2)[0] == pytest.approx(before)
    assert held(b, 0.1, 0.0, 1)[0] == pytest.approx(before + 0.0033)


def test_effect_acts_after_the_wheels_limit() -> None:
    b = body()
    b.switch_on("input_gain:w gain=0.5")
    limit = 0.4 / 0.105
    assert held(b, 0.0, 10.0, 1)[2] == pytest.approx(0.033 * 0.5 * limit)


def test_robot_slides_along_the_arc_that_it_drives() -> None:
    b = body()
    b.switch_on("constant_disturbance:body x=0 y=0.1")
    x, y, _ = held(b, 0.0, 1.0, 90)
    turned = 90 * 0.033
    # the left of a heading that turns from 0: (-sin, cos), averaged over the way
    assert (x, y) == pytest.approx((0.1 * (math.cos(turned) - 1.0), 0.1 * math.sin(turned)), abs=1e-12)


def test_sensor_that_is_mounted_askew_shows_another_pose_and_the_robot_is_where_it_is() -> None:
    b, straight = body(), body()
    b.switch_on("heading_offset:theta angle=0.2")
    b.switch_on("sensor_lever_arm x=0.1 y=0")
    x, y, theta = held(b, 0.1, 0.5, 40)
    assert (x, y, theta) == held(straight, 0.1, 0.5, 40)
    assert b.observe() == pytest.approx((x + 0.1 * math.cos(theta + 0.2), y + 0.1 * math.sin(theta + 0.2), theta + 0.2))


def test_effect_with_a_matrix_is_read() -> None:
    b = body(start=(0.5, 0.0, 0.0))
    b.switch_on("position_field matrix=[[0,0],[0.2,0]]")
    assert held(b, 0.0, 0.0, 10)[:2] == pytest.approx((0.5, 0.5 * 0.2 * 0.33))


def test_slip_patch_is_a_place() -> None:
    b = body()
    b.switch_on("slip_patch x=0.5 y=0 radius=0.2 gain=0.4")
    steps = [after - before for before, after in itertools.pairwise(held(b, 0.1, 0.0, 1)[0] for _ in range(500))]
    assert steps[0] == pytest.approx(0.0033)
    assert min(steps) == pytest.approx(0.4 * 0.0033)
    assert steps[-1] == pytest.approx(0.0033)


def test_heading_ripple_needs_speed() -> None:
    b = body(start=(0.0, 0.0, 0.5))
    b.switch_on("heading_ripple amplitude=3 waves=2")
    assert held(b, 0.0, 0.0, 5)[2] == 0.5
    assert held(b, 0.2, 0.0, 1)[2] == pytest.approx(0.5 + 0.033 * 3 * 0.2 * math.sin(1.0))


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", "is empty"),
        ("input_gian:w gain=1", "did you mean 'input_gain'"),
        ("input_gain:q gain=1", "must be one of"),
        ("input_gain:w gain", "must be PARAMETER=VALUE"),
        ("input_gain:w factor=1", "has no parameter 'factor'"),
        ("slip_patch x=0 y=0 radius=1", "takes the numbers x, y, radius, gain"),
        ("slip_patch x=0 y=0 radius=1 gain=nan", "gain must be finite"),
        ("slip_patch x=0 y=0 radius=much gain=1", "takes the numbers"),
    ],
)
def test_effect_that_does_not_exist_is_refused_with_what_would_be_right(text: str, says: str) -> None:
    with pytest.raises(ConfigError, match=says):
        body().switch_on(text)


def test_robot_without_effects_of_the_library_does_without_numpy() -> None:
    code = "import sys, s2r_standins.robotarium; sys.exit('numpy' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
