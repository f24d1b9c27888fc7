"""The quadruped in-process: it walks, goes where it is told to, is the same for the same seed, and what is wrong with it shows."""

from __future__ import annotations

import math
import random
import subprocess
import sys
from pathlib import Path

import pytest
from s2r_standins.quadruped import ROBOT
from s2r_standins.quadruped_faults import KNOWN, parse_fault

from s2r_runtime.errors import ConfigError

pytest.importorskip("mujoco")
from s2r_standins.quadruped_body import HEIGHT, Quadruped

V_MAX, W_MAX = 0.15, 0.3


@pytest.fixture(scope="module")
def made() -> Quadruped:
    return Quadruped()


@pytest.fixture
def robot(made: Quadruped) -> Quadruped:
    made.clear()
    made.reset(1)
    return made


def speeds(robot: Quadruped, v: float, w: float, seconds: float = 3.0, first: float = 1.5) -> tuple[float, float, float]:
    """Mean speed forward, to the left, and of yaw, after `first` s under the command."""
    before = robot.step(v, w, first)
    forward = left = turned = 0.0
    for _ in range(round(10.0 * seconds)):
        after = robot.step(v, w, 0.1)
        turn = math.remainder(after[2] - before[2], 2.0 * math.pi)
        middle, dx, dy = before[2] + 0.5 * turn, after[0] - before[0], after[1] - before[1]
        forward, left, turned = (
            forward + dx * math.cos(middle) + dy * math.sin(middle),
            left + dy * math.cos(middle) - dx * math.sin(middle),
            turned + turn,
        )
        before = after
    return forward / seconds, left / seconds, turned / seconds


def lean(robot: Quadruped) -> tuple[float, float]:
    """Roll (left side up) and pitch (nose down), rad, for small ones."""
    a, b, c, d = robot.joints()[3:7]
    return 2.0 * (a * b + c * d), 2.0 * (a * c - b * d)


# ---------------------------------------------------------------- walking


@pytest.mark.parametrize("friction", [0.4, 0.8])
def test_it_walks_through_random_commands_without_falling(robot: Quadruped, friction: float) -> None:
    robot.switch_on(f"floor friction={friction}")
    rng, way = random.Random(friction), 0.0
    while robot.now_s < 20.0:
        robot.step(rng.uniform(-V_MAX, V_MAX), rng.uniform(-W_MAX, W_MAX), rng.uniform(0.9, 1.1))
        assert max(map(abs, lean(robot))) < math.radians(5.0)
        way = max(way, math.hypot(*robot.pose()[:2]))
    assert robot.fallen == ""
    assert way > 0.1


@pytest.mark.parametrize(("v", "w"), [(0.15, 0.0), (-0.15, 0.15), (0.0, -0.3)])
def test_mean_speeds_are_those_commanded(robot: Quadruped, v: float, w: float) -> None:
    forward, left, turned = speeds(robot, v, w, seconds=5.0)
    # gains 0.9 to 1.05 and biases of 0.01, both ways
    assert abs(forward - v) <= 0.05 * abs(v) + 0.01
    assert abs(turned - w) <= 0.05 * abs(w) + 0.01
    assert abs(left) <= 0.01


def test_feet_are_lifted_clear_of_the_floor_and_stand_still_on_it(robot: Quadruped) -> None:
    robot.step(0.15, 0.0, 2.0)
    feet = [robot.model.geom(f"{leg}_foot").id for leg in ("front_left", "front_right", "rear_left", "rear_right")]
    lifted, slid, stood = [0.0] * 4, 0.0, 0
    before = robot.data.geom_xpos[feet].copy()
    for _ in range(1000):
        robot.step(0.15, 0.0, 0.001)
        after = robot.data.geom_xpos[feet].copy()
        for i in range(4):
            lifted[i] = max(lifted[i], after[i, 2] - 0.022)
            if after[i, 2] < 0.0225:
                slid += math.hypot(*(after[i] - before[i])[:2])
                stood += 1
        before = after
    assert min(lifted) > 0.03
    # the trunk passes over a foot at 0.15 m/s; the ball under it rolls by about a tenth of that
    assert slid / (stood * 0.001) < 0.03
    assert stood > 1000, "two of four stand at any time"


def test_zero_command_ends_in_standing_and_a_new_one_in_walking(robot: Quadruped) -> None:
    robot.step(0.15, 0.1, 2.0)
    robot.step(0.0, 0.0, 2.0)
    x, y, theta = robot.pose()
    robot.step(0.0, 0.0, 1.0)
    assert math.dist(robot.pose(), (x, y, theta)) < 1e-3
    assert max(map(abs, robot.joints()[19:])) < 0.05, "every joint is still"
    assert robot.step(0.15, 0.0, 2.0)[0] - x > 0.1


def test_commands_beyond_the_data_sheet_are_clipped_to_it(robot: Quadruped) -> None:
    fast = robot.step(9.0, -9.0, 1.0)
    robot.reset(1)
    assert robot.step(V_MAX, -W_MAX, 1.0) == fast


# ---------------------------------------------------------------- the same robot again


def test_one_seed_is_one_robot_to_the_bit_and_another_seed_another(robot: Quadruped) -> None:
    def story(one: Quadruped, seed: int) -> list[float]:
        one.reset(seed)
        one.step(0.1, 0.2, 1.5)
        return [*one.joints(), *one.observe()]

    robot.switch_on("shoves force=30 rate=2")
    other = Quadruped(seed=99)
    other.switch_on("shoves force=30 rate=2")
    other.step(0.1, -0.1, 0.7)
    assert story(robot, 4) == story(other, 4), "whatever either did before"
    assert story(robot, 4) != story(robot, 5)


def test_state_is_all_that_it_goes_on_from(robot: Quadruped) -> None:
    robot.switch_on("latency delay=0.15")
    robot.switch_on("shoves force=30 rate=2")
    robot.step(0.1, 0.2, 1.234)
    robot.step(-0.1, 0.0, 0.05)
    kept = robot.state()
    on = [robot.step(0.15, -0.3, 1.0), robot.joints(), robot.observe(), robot.now_s]
    robot.step(-0.1, 0.1, 0.5)
    robot.restore(kept)
    assert [robot.step(0.15, -0.3, 1.0), robot.joints(), robot.observe(), robot.now_s] == on
    other = Quadruped(seed=77)
    for effect in ("latency delay=0.15", "shoves force=30 rate=2"):
        other.switch_on(effect)
    other.restore(kept)
    assert [other.step(0.15, -0.3, 1.0), other.joints(), other.observe(), other.now_s] == on


def test_placed_elsewhere_it_walks_on_as_it_would_have_there(robot: Quadruped) -> None:
    robot.step(0.12, 0.2, 1.3)
    kept, (x, y, theta) = robot.state(), robot.pose()
    ahead = robot.step(0.12, 0.2, 0.5)
    robot.restore(kept)
    robot.place(1.0, -2.0, 2.5)
    assert robot.pose() == pytest.approx((1.0, -2.0, 2.5), abs=1e-12)
    moved, turn = robot.step(0.12, 0.2, 0.5), 2.5 - theta
    dx, dy = ahead[0] - x, ahead[1] - y
    expected = (1.0 + math.cos(turn) * dx - math.sin(turn) * dy, -2.0 + math.sin(turn) * dx + math.cos(turn) * dy)
    # friction's pyramids lie along the floor's axes, so that it is not quite the same walk
    assert moved[:2] == pytest.approx(expected, abs=3e-3)
    assert math.remainder(moved[2] - turn - ahead[2], 2.0 * math.pi) == pytest.approx(0.0, abs=1e-2)


# ---------------------------------------------------------------- what is wrong with it


def test_payload_presses_the_trunk_down_and_to_its_side_and_drags_on_the_walk(robot: Quadruped) -> None:
    def standing(effect: str) -> tuple[float, float, float]:
        robot.clear()
        if effect:
            robot.switch_on(effect)
        robot.reset(1)
        robot.step(0.0, 0.0, 1.0)
        return robot.joints()[2], *lean(robot)

    height, roll, pitch = standing("")
    assert standing("payload mass=4")[0] < height - 0.002
    assert standing("payload mass=3 x=0.15")[2] > pitch + 0.003, "nose down"
    assert standing("payload mass=3 y=0.08")[1] < roll - 0.005, "left side down"
    robot.clear()
    free = speeds(robot, 0.12, 0.0)[0]
    robot.switch_on("payload mass=4")
    assert speeds(robot, 0.12, 0.0)[0] < free - 0.01


def test_what_stands_on_a_slope_slides_down_where_the_floor_is_slippery_only(robot: Quadruped) -> None:
    for friction, slides in ((0.8, False), (0.1, True)):
        robot.clear()
        robot.switch_on("slope angle=0.2 direction=1.5708")
        robot.switch_on(f"floor friction={friction}")
        robot.reset(1)
        # a block would slide by (9.81 sin 0.2 - 0.1 * 9.81 cos 0.2)/2 = 0.49 m in the first second
        assert (robot.step(0.0, 0.0, 1.0)[1] < -0.2) == slides


def test_slope_holds_back_who_climbs_and_draws_who_descends(robot: Quadruped) -> None:
    robot.switch_on("slope angle=0.1")
    assert speeds(robot, 0.12, 0.0)[0] < 0.105
    robot.reset(1)
    assert speeds(robot, -0.12, 0.0)[0] < -0.135
    robot.reset(1)
    robot.place(0.0, 0.0, math.pi / 2.0)
    assert speeds(robot, 0.12, 0.0)[1] > 0.003, "across the slope it is drawn downhill, which is to its left"


def test_weak_leg_sags_at_its_corner_and_turns_the_walk_to_its_side(robot: Quadruped) -> None:
    robot.switch_on("weak_leg leg=rear_right strength=0.6")
    robot.step(0.0, 0.0, 1.0)
    roll, pitch = lean(robot)
    assert roll > 0.002, "its right side is lower"
    assert pitch < 0.0, "its rear is"
    assert speeds(robot, 0.12, 0.0)[2] < -0.03
    assert robot.fallen == ""


def test_latency_is_the_time_by_which_it_begins_later(robot: Quadruped) -> None:
    free = [robot.step(0.15, 0.0, 0.1)[0] for _ in range(15)]
    robot.reset(1)
    robot.switch_on("latency delay=0.5")
    late = [robot.step(0.15, 0.0, 0.1)[0] for _ in range(20)]
    assert late[4] == pytest.approx(0.0, abs=1e-3)
    assert late[5:] == pytest.approx(free, abs=2e-3)


def test_shoves_come_at_their_rate_and_push(robot: Quadruped) -> None:
    robot.switch_on("shoves force=60 rate=1")
    begun, pushed = 0, False
    for _ in range(400):
        robot.step(0.0, 0.0, 0.05)
        force = math.hypot(*robot.data.xfrc_applied[robot.model.body("trunk").id][:2])
        assert force == pytest.approx(60.0 if force else 0.0)
        begun, pushed = begun + (force > 0.0 and not pushed), force > 0.0
    # every 1.1 s on average (a wait, and 0.1 s of pushing): 18 in 20 s, with a standard deviation of sqrt(20 * 1.0/1.1^3) = 3.9
    assert 5 <= begun <= 31
    assert math.hypot(*robot.pose()[:2]) > 1e-3
    robot.clear()
    robot.step(0.0, 0.0, 0.1)
    assert not robot.data.xfrc_applied.any()


def test_effects_are_gone_when_they_are_cleared(robot: Quadruped) -> None:
    free = robot.step(0.1, 0.1, 1.0)
    for effect in ("payload mass=3 x=0.1", "floor friction=0.3", "slope angle=0.1", "weak_leg leg=front_left strength=0.5"):
        robot.switch_on(effect)
    robot.reset(1)
    assert math.dist(robot.step(0.1, 0.1, 1.0), free) > 1e-3
    robot.clear()
    robot.reset(1)
    assert robot.step(0.1, 0.1, 1.0) == free


def test_a_fall_is_told_and_stays_told(robot: Quadruped) -> None:
    robot.switch_on("weak_leg leg=rear_left strength=0")
    robot.switch_on("weak_leg leg=rear_right strength=0")
    robot.step(0.1, 0.0, 2.0)
    assert robot.fallen.startswith("fell: trunk at 0."), "it sits"
    robot.clear()
    robot.step(0.1, 0.0, 1.0)
    assert robot.trouble == robot.fallen != ""
    assert robot.joints()[2] < HEIGHT - 0.05
    robot.reset(1)
    assert robot.fallen == ""


def test_physics_that_fail_are_a_fall(robot: Quadruped, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)  # the engine leaves a log of it where it runs
    robot.data.qvel[0] = math.nan
    robot.step(0.1, 0.0, 0.1)
    assert robot.fallen.startswith("fell: trunk at nan m")
    robot.reset(1)
    assert robot.step(0.1, 0.0, 1.0)[0] > 0.0
    assert robot.fallen == ""


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", "unknown effect ''"),
        ("input_gain:w gain=0.7", "the quadruped has: payload, floor, slope, weak_leg, latency, shoves"),
        ("payload", "mass must be a number from 0 to 10 kg"),
        ("payload mass=nan", "mass must be a number"),
        ("payload mass=1 mass=2", "once each"),
        ("payload mass=1 z=2", "mass, x, y"),
        ("weak_leg strength=0.5", "leg must be one of front_left, front_right, rear_left, rear_right"),
        ("weak_leg leg=3 strength=0.5", "leg must be one of"),
        ("slope angle=2", "from 0 to 0.5 rad"),
    ],
)
def test_bad_effect_is_one_clear_line(text: str, says: str) -> None:
    with pytest.raises(ConfigError) as told:
        parse_fault(text)
    assert says in str(told.value)
    assert "\n" not in str(told.value)


def test_help_names_every_effect_and_its_parameters() -> None:
    done = subprocess.run([sys.executable, "-m", "s2r_standins.quadruped", "--help"], capture_output=True, text=True, check=True)
    for name, parameters in KNOWN.items():
        assert f"  {name} " in done.stdout
        for parameter in parameters:
            assert f"{parameter}=" in done.stdout


def test_without_its_physics_engine_it_says_what_to_install(tmp_path_factory: pytest.TempPathFactory) -> None:
    empty = tmp_path_factory.mktemp("nothing")
    code = (
        "import sys; sys.modules['mujoco'] = None\n"  # as if it were not there, for find_spec and import alike
        "from s2r_standins.quadruped import ROBOT, main\n"
        "from s2r_runtime.errors import ConfigError\n"
        "from s2r_runtime.plugins import registry\n"
        "assert registry().get('robots', 'quadruped') is ROBOT\n"
        "try: ROBOT.command(1, [])\n"
        "except ConfigError as error: print(error)\n"
        "sys.exit(main([]))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=empty, check=False)
    assert done.stdout == "robot 'quadruped' needs the physics engine mujoco: pip install 's2r-standins[sim]'\n"
    assert done.stderr == f"quadruped: {done.stdout}"
    assert done.returncode == 78


def test_unknown_controller_is_named() -> None:
    with pytest.raises(ConfigError, match="there are: good"):
        ROBOT.controller("heroic")
