"""The campaign draws the law it says it draws, survives what robots do, and never looks at where the robot should have gone."""

from __future__ import annotations

import itertools
import math
import random
import subprocess
import sys
from collections.abc import Callable

import msgspec
import pytest

from s2r_runtime.errors import ConfigError
from s2r_runtime.evidence.comparison import ATTEMPTS, JITTER_PERIODS, Campaign, CampaignStep
from s2r_runtime.messages import GRID, RULES, Observation, SampleTaken
from s2r_runtime.profile import Sampling

DT = 0.033
DT_NS = 33_000_000
REGION = ((-1.6, 1.6), (-1.0, 1.0), (-math.pi, math.pi))
WIDE = ((-2.1, 2.1), (-1.5, 1.5), (-math.pi, math.pi))
BOUNDS = ((-0.2, 0.2), (-math.pi, math.pi))
SHORT = Sampling(hold_periods=10)
FIRST = Sampling(hold_periods=10, period="first")


def campaign(
    n: int = 5, settings: Sampling = SHORT, fence: tuple[tuple[float, float], ...] = WIDE, seed: int = 1, *, any_step: bool = False
) -> Campaign:
    names = ("x", "y", "theta")
    return Campaign("unicycle", names, ("theta",), REGION, fence, BOUNDS, DT, settings, n=n, epoch=1, seed=seed, any_step=any_step)


class Robot:
    """Unicycle with clipped wheels, a command that acts one period late, and pose noise."""

    def __init__(self, seed: int = 0, noise: float = 0.0005) -> None:
        self.x, self.k, self.waiting = (0.1, -0.2, 0.5), 0, (0.0, 0.0)
        self.random, self.noise = random.Random(seed), noise

    def observe(self) -> Observation:
        x = tuple(value + self.random.gauss(0.0, self.noise) for value in self.x)
        return Observation(self.k, self.k * DT_NS, (x[0], x[1], math.remainder(x[2], 2.0 * math.pi)))

    def move(self, u: tuple[float, ...]) -> None:
        right, left = (min(max(self.waiting[0] + sign * 0.0525 * self.waiting[1], -0.2), 0.2) for sign in (1, -1))
        v, w = 0.5 * (right + left), (right - left) / 0.105
        x, y, theta = self.x
        self.x = (x + DT * v * math.cos(theta), y + DT * v * math.sin(theta), theta + DT * w)
        self.waiting, self.k = (u[0], u[1]), self.k + 1


def drive(
    c: Campaign, robot: Robot, periods: int = 20_000, see: Callable[[Observation], Observation | None] = lambda o: o
) -> tuple[list[SampleTaken], CampaignStep]:
    """Runs until the campaign is over; `see` may change or lose an observation, then the last command stays."""
    samples, step, u = [], CampaignStep((0.0, 0.0), ""), (0.0, 0.0)
    for _ in range(periods):
        seen = see(robot.observe())
        if seen is not None:
            step = c.step(seen)
            u = (step.u[0], step.u[1])
            if step.sample:
                samples.append(step.sample)
            if step.done or step.failed:
                break
        robot.move(u)
    return samples, step


def test_campaign_takes_what_was_fixed_beforehand_and_then_rests() -> None:
    c = campaign(6)
    samples, last = drive(c, Robot())
    assert [s.index for s in samples] == list(range(6))
    assert last.done
    assert last.u == (0.0, 0.0)
    assert c.step(Observation(10**6, 10**15, (0.0, 0.0, 0.0))).done
    assert c.progress().left_s == 0.0


@pytest.mark.parametrize("settings", [FIRST, SHORT], ids=["first", "random"])
def test_sample_is_one_period_of_a_hold_from_rest_and_the_holds_end(settings: Sampling) -> None:
    robot = Robot()
    seen: dict[int, Observation] = {}
    commands: dict[int, tuple[float, ...]] = {}
    c = campaign(4, settings)
    samples = []
    while len(samples) < 4:
        o = robot.observe()
        step = c.step(o)
        seen[o.seq], commands[o.seq] = o, step.u
        if step.sample:
            samples.append(step.sample)
        robot.move(step.u)
    for s in samples:
        k, begin = s.obs_seq0, s.start_seq
        assert (s.x0, s.x1, s.start, s.held) == (seen[k].x, seen[k + 1].x, seen[begin].x, seen[begin + 10].x)
        assert (s.t0_ns, s.lasts_ns, s.start_ns, s.hold_ns) == (seen[k].stamp_ns, DT_NS, seen[begin].stamp_ns, 10 * DT_NS)
        assert (s.periods, s.period) == (10, k - begin)
        assert all(commands[begin + i] == s.u for i in range(10))
        assert all(commands[begin - 1 - i] == (0.0, 0.0) for i in range(settings.stop_periods))
    assert all((s.period == 0) for s in samples) is (settings is FIRST)


@pytest.mark.slow
def test_the_period_of_a_hold_is_drawn_uniformly() -> None:
    """Chi-square with 9 degrees of freedom against its 1 - 1e-4 quantile, 33.7."""
    samples, last = drive(campaign(400), Robot(), periods=200_000)
    assert last.done
    counts = [sum(s.period == j for s in samples) for j in range(10)]
    assert sum((count - 40.0) ** 2 / 40.0 for count in counts) < 33.7


def test_the_commands_before_a_hold_are_recorded_with_how_long_each_lasted() -> None:
    robot, c, commands, samples = Robot(), campaign(5), [], []
    while len(samples) < 5:
        o = robot.observe()
        step = c.step(o)
        samples += [step.sample] if step.sample else []
        commands.append((step.u[0], step.u[1]))
        robot.move(step.u)
    for s in samples:
        periods = [ns // DT_NS for ns in s.past_ns]
        told = [u for u, count in zip(s.past_u, periods, strict=True) for _ in range(count)]
        assert told == commands[s.start_seq - len(told) : s.start_seq]
        assert len(told) >= SHORT.stop_periods + 1
        assert sum(s.past_ns) == len(told) * DT_NS


@pytest.mark.slow
def test_law_is_uniform_over_inputs_and_region_and_independent_of_the_sample_before() -> None:
    """Quarters of each input, and of (this, the one before), are hit alike: chi-square with 3 and 15 degrees of freedom against the
    1 - 1e-4 quantiles, 21.1 and 44.3. x0 lies up to 0.1 m before its waypoint, so for it only coverage is asked: 16 fields, of which
    the rarest has a share of at least 0.03 (a waypoint's quarter less 0.1 m a side, squared): missed with probability 16 e^-12.
    """
    samples, last = drive(campaign(400), Robot(), periods=200_000)
    assert last.done
    for i, (low, high) in enumerate(BOUNDS):
        quarter = [int(4 * (s.u[i] - low) / (high - low)) for s in samples]
        assert sum((quarter.count(q) - 100.0) ** 2 / 100.0 for q in range(4)) < 21.1
        pairs = list(itertools.pairwise(quarter))
        expected = len(pairs) / 16
        assert sum((pairs.count((a, b)) - expected) ** 2 / expected for a in range(4) for b in range(4)) < 44.3
    assert all(abs(s.x0[0]) < 1.55 and abs(s.x0[1]) < 0.95 for s in samples)
    assert len({(int(4 * (s.x0[0] + 1.6) / 3.2), int(4 * (s.x0[1] + 1.0) / 2.0)) for s in samples}) == 16


def test_hold_does_not_leave_a_geofence_no_wider_than_the_region() -> None:
    settings = Sampling()  # 50 periods: up to 0.33 m
    robot, fence = Robot(), (*REGION[:2], (-math.pi, math.pi))
    c = campaign(40, settings, fence)
    worst = 0.0
    for _ in range(60_000):
        step = c.step(robot.observe())
        if step.done or step.failed:
            break
        robot.move(step.u)
        worst = max(worst, abs(robot.x[0]) - 1.6, abs(robot.x[1]) - 1.0)
    assert step.done
    assert worst <= 0.0


def test_x0_outside_the_region_is_rejected_and_counted() -> None:
    """A robot that rolls on after the stop ends up outside now and then."""

    class Rolling(Robot):
        def move(self, u: tuple[float, ...]) -> None:
            x, y, _ = self.x
            super().move(u if any(u) else (0.2, 0.0))
            if not any(u):
                self.x = (x + 0.1, y, self.x[2])

    c = campaign(20, Sampling(hold_periods=5, stop_periods=3, max_rejections=1000))
    samples, last = drive(c, Rolling())
    assert last.done
    assert all(-1.6 <= s.x0[0] <= 1.6 for s in samples)
    assert c.progress().rejected["outside_region"] > 0


def test_lost_observations_cost_samples_not_truth() -> None:
    lose = random.Random(3)
    robot, c = Robot(), campaign(30, FIRST)
    stamps: dict[tuple[float, ...], int] = {}

    def see(o: Observation) -> Observation | None:
        stamps[o.x] = o.stamp_ns
        return None if lose.random() < 0.1 else o

    samples, last = drive(c, robot, periods=60_000, see=see)
    assert last.done
    for s in samples:
        assert stamps[s.x1] - stamps[s.x0] == DT_NS
        assert stamps[s.held] - stamps[s.x0] == 10 * DT_NS
    # x1 or the hold's end is lost with probability .19: of 30 + rejected tries, the 99.9 % interval of Bin(37, .19) is 1 to 16
    assert 1 <= c.progress().rejected["off_step"] <= 20


def test_a_lost_observation_costs_a_random_period_only_at_the_holds_end() -> None:
    """Another period of the hold counts: only the end is lost with probability .1; of 30 + 12 tries Bin(42, .1) is 12 at most (99.9 %)."""
    lose = random.Random(3)
    c = campaign(30)
    samples, last = drive(c, Robot(), periods=60_000, see=lambda o: None if lose.random() < 0.1 else o)
    assert last.done
    assert all(s.lasts_ns == DT_NS and s.hold_ns == 10 * DT_NS for s in samples)
    assert c.progress().rejected.get("off_step", 0) <= 12


def test_faulty_observation_counts_as_lost() -> None:
    robot, c = Robot(), campaign(3)

    def see(o: Observation) -> Observation:
        return msgspec.structs.replace(o, x=(), fault="not a number") if o.seq % 7 == 0 else o

    samples, last = drive(c, robot, see=see)
    assert last.done
    assert all(s.obs_seq0 % 7 not in {0, 6, 4} for s in samples)


@pytest.mark.parametrize("settings", [FIRST, SHORT], ids=["first", "random"])
@pytest.mark.parametrize(
    ("shift", "any_step", "fine"), [(0.009, False, True), (0.02, False, False), (0.15, True, True), (0.3, True, False)]
)
def test_a_sample_that_was_no_step_long_is_rejected(shift: float, any_step: bool, fine: bool, settings: Sampling) -> None:
    """Every second stamp is late. What takes steps of any length may take a fifth more, and never less than 1 % of one."""
    c, robot = campaign(2, msgspec.structs.replace(settings, max_rejections=9), any_step=any_step), Robot()
    samples, last = drive(c, robot, see=lambda o: msgspec.structs.replace(o, stamp_ns=o.stamp_ns + (o.seq % 2) * int(shift * DT_NS)))
    assert last.done is fine
    assert ("off_step" in last.failed) is not fine
    assert all(0.99 <= s.lasts_ns / DT_NS <= 1.2 for s in samples)
    if not fine:
        assert "let the robot report a whole number of times a step" in last.failed


def test_refused_command_costs_the_sample_under_way() -> None:
    robot, c = Robot(), campaign(3)
    samples, refusals = [], 0
    for _ in range(20_000):
        o = robot.observe()
        step = c.step(o)
        u = step.u
        if step.sample:
            samples.append(step.sample)
        if step.done:
            break
        if step.phase == "hold" and refusals < 2:
            refusals, u = refusals + 1, (0.0, 0.0)
            c.refused(o.seq, "outside_geofence")
        robot.move(u)
    assert len(samples) == 3
    assert c.progress().rejected == {"outside_geofence": 2}


def test_gate_that_refuses_everything_ends_the_campaign_by_name() -> None:
    robot, c = Robot(), campaign(3)
    for _ in range(1000):
        o = robot.observe()
        step = c.step(o)
        if step.failed:
            break
        c.refused(o.seq, "no_permit")
        robot.move((0.0, 0.0))
    assert "no_permit" in step.failed
    assert robot.k == pytest.approx(Sampling().stuck_after / DT, abs=2)


def test_robot_that_does_not_move_fails_after_several_waypoints() -> None:
    robot, c = Robot(), campaign(3)
    start = robot.x
    for _ in range(5000):
        step = c.step(robot.observe())
        if step.failed:
            break
        robot.move(step.u)
        robot.x = start
    assert "did not move from (0.10, -0.20) m" in step.failed
    assert step.u == (0.0, 0.0)
    assert robot.k * DT == pytest.approx(ATTEMPTS * SHORT.stuck_after, rel=0.05)
    assert c.step(robot.observe()).failed == step.failed


def test_robot_freed_within_a_few_waypoints_goes_on() -> None:
    robot, c = Robot(), campaign(3)
    start, freed = robot.x, int(2.5 * SHORT.stuck_after / DT)
    for k in range(20_000):
        step = c.step(robot.observe())
        if step.done:
            break
        robot.move(step.u)
        if k < freed:
            robot.x = start
    assert step.done
    assert c.progress().rejected == {"stuck": 2}


def test_waypoint_that_cannot_be_reached_in_time_is_given_up() -> None:
    class Slow(Robot):
        def move(self, u: tuple[float, ...]) -> None:
            super().move((0.1 * u[0], u[1]))

    c = campaign(2, Sampling(hold_periods=5, waypoint_timeout=20.0))
    _, last = drive(c, Slow())
    assert last.done
    assert c.progress().rejected["timeout"] > 0


def test_robot_that_takes_small_commands_for_none_is_asked_for_more_within_its_bounds() -> None:
    class Numb(Robot):
        def move(self, u: tuple[float, ...]) -> None:
            assert all(low <= value <= high for value, (low, high) in zip(u, BOUNDS, strict=True))
            super().move((u[0] if abs(u[0]) > 0.15 else 0.0, u[1]))  # 0.15 m/s is asked for 0.15 m from a waypoint of 0.1 m

    samples, last = drive(campaign(3), Numb())
    assert last.done
    assert len(samples) == 3


def test_robot_that_kicks_where_it_lies_is_given_up_after_several_waypoints() -> None:
    robot, c = Robot(), campaign(3, Sampling(hold_periods=5, waypoint_timeout=20.0))
    start, kicks = robot.x, random.Random(1)
    for _ in range(20_000):
        step = c.step(robot.observe())
        if step.failed:
            break
        robot.move(step.u)
        robot.x = (start[0] + kicks.uniform(-0.05, 0.05), start[1], kicks.uniform(-3.0, 3.0))
    assert step.failed.startswith(f"stuck: {ATTEMPTS} waypoints in a row were not reached")
    assert "in 20 s the robot came hardly nearer" in step.failed
    assert c.progress().rejected == {"timeout": ATTEMPTS - 1}


def test_too_many_rejections_fail_with_their_counts() -> None:
    c = campaign(50, Sampling(hold_periods=10, max_rejections=4, period="first"))
    _, last = drive(c, Robot(), see=lambda o: None if o.seq % 5 == 0 else o)
    assert last.failed.startswith("more than 4 samples were rejected after")
    assert "off_step 5" in last.failed


def test_interrupted_campaign_resumes_with_fresh_draws_and_ends_with_the_same_number() -> None:
    whole, _ = drive(campaign(6), Robot())
    first, robot, samples = campaign(6), Robot(), []
    while len(samples) < 3:
        step = first.step(robot.observe())
        samples += [step.sample] if step.sample else []
        robot.move(step.u)
    saved = msgspec.json.decode(msgspec.json.encode(first.snapshot()))
    second = campaign(6)
    second.restore(saved)
    rest, last = drive(second, robot)
    assert last.done
    assert [s.index for s in samples + rest] == list(range(6))
    assert [s.u for s in samples] == [s.u for s in whole[:3]]
    assert not {s.u for s in rest} & {s.u for s in whole}
    third = campaign(6)
    third.restore(second.snapshot())
    assert third.snapshot()["run"] == 2


def test_same_seed_gives_the_same_campaign_and_another_seed_another() -> None:
    one, again, other = (drive(campaign(3, seed=s), Robot())[0] for s in (1, 1, 2))
    assert one == again
    assert not {s.u for s in one} & {s.u for s in other}


def test_snapshot_of_other_settings_is_refused() -> None:
    saved = campaign(6).snapshot()
    with pytest.raises(ConfigError, match="other settings"):
        campaign(7).restore(saved)
    with pytest.raises(ConfigError, match="campaign snapshot"):
        campaign(6).restore({**saved, "index": "three"})


def test_a_campaign_goes_on_after_an_upgrade_whose_rules_draw_no_otherwise() -> None:
    names = ("x", "y", "theta")
    before, now = (
        Campaign("unicycle", names, ("theta",), REGION, WIDE, BOUNDS, DT, SHORT, n=6, epoch=1, seed=1, rules=rules)
        for rules in (GRID, RULES)
    )
    samples, robot = [], Robot()
    while len(samples) < 3:
        step = before.step(robot.observe())
        samples += [step.sample] if step.sample else []
        robot.move(step.u)
    now.restore(before.snapshot())
    rest, last = drive(now, robot)
    assert last.done
    assert [s.index for s in rest] == [3, 4, 5]


def test_stop_lasts_as_long_as_asked_and_varies() -> None:
    robot, c, lengths, length = Robot(), campaign(25), set(), 0
    for _ in range(50_000):
        step = c.step(robot.observe())
        if step.done:
            break
        if step.phase == "stop":
            length += 1
        elif length:
            lengths.add(length)
            length = 0
        robot.move(step.u)
    assert lengths == {SHORT.stop_periods + i for i in range(JITTER_PERIODS)}


def test_pause_during_a_hold_counts_as_interruption() -> None:
    robot, c, paused = Robot(), campaign(2), False
    for _ in range(20_000):
        step = c.step(robot.observe())
        if step.done:
            break
        robot.move(step.u)
        if step.phase == "hold" and not paused:
            paused, robot.k = True, robot.k + 100
    assert c.progress().rejected == {"interrupted": 1}


def test_periods_of_a_second_whose_stamps_jitter_are_no_pauses() -> None:
    names, jitter = ("x", "y", "theta"), random.Random(2)
    settings = Sampling(hold_periods=3, stop_periods=1, position_gain=0.4, heading_gain=0.5)
    c = Campaign("unicycle", names, ("theta",), REGION, WIDE, BOUNDS, 1.0, settings, n=4, epoch=1, seed=1, any_step=True)
    x, y, theta, t = 0.0, 0.0, 0.0, 0.0
    for k in range(2000):
        step = c.step(Observation(k, round(t * 1e9), (x, y, theta)))
        if step.done:
            break
        dt = jitter.gauss(1.0, 0.02)
        x, y, t = x + dt * step.u[0] * math.cos(theta), y + dt * step.u[0] * math.sin(theta), t + dt
        theta = math.remainder(theta + dt * step.u[1], 2.0 * math.pi)
    assert step.done
    assert "interrupted" not in c.progress().rejected
    assert c.progress().elapsed_s == pytest.approx(t)


def test_time_left_follows_the_pace_in_robot_time() -> None:
    robot, c = Robot(), campaign(10)
    assert c.progress().left_s is None
    while c.progress().taken < 5:
        robot.move(c.step(robot.observe()).u)
    done = c.progress()
    assert done.elapsed_s == pytest.approx((robot.k - 1) * DT)
    assert done.left_s == pytest.approx(done.elapsed_s)


def test_region_without_room_for_waypoints_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"waypoint_margin is 1.0 m: it leaves no room for waypoints along 'y'"):
        campaign(1, Sampling(waypoint_margin=1.0))


def test_model_without_a_way_to_a_waypoint_is_refused() -> None:
    with pytest.raises(ConfigError, match="no go-to law"):
        Campaign("joint", ("q", "qd"), (), ((-1.0, 1.0),) * 2, ((-1.0, 1.0),) * 2, ((-1.0, 1.0),), DT, SHORT, n=1, epoch=1, seed=1)


def test_the_daemons_process_gets_no_numpy_from_the_campaign() -> None:
    code = "import sys, s2r_runtime.evidence.comparison; sys.exit('numpy' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_the_robot_stood_still_in_the_two_observations_up_to_the_hold() -> None:
    """Their difference shows the measurement noise; with the robot's own, 5 standard deviations of it are never exceeded here."""
    noise = 0.0005
    samples, _ = drive(campaign(20), Robot(noise=noise))
    for sample in samples:
        assert all(
            abs(math.remainder(a - b, 2.0 * math.pi)) < 5.0 * noise * math.sqrt(2.0)
            for a, b in zip(sample.start, sample.before, strict=True)
        )
    assert any(sample.start != sample.before for sample in samples)
