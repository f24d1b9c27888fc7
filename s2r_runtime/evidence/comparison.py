"""Samples the comparison distribution on a robot (paper, section V): the campaign as a pure, seeded, resumable state machine.

One sample, from observations x and inputs u, one each period of dt:

    goto   waypoint ~ uniform(box inside region and geofence); Lyapunov go-to until within `waypoint_radius`. A robot that stands
           still under it (stiction; a walker that takes small commands for none) is asked for more of the same, within its bounds
    stop   zero input for `stop_periods` periods and 0 to 3 more (drawn: a robot or camera with a rhythm of its own is not
           met at one phase of it again and again)
    hold   u ~ uniform(input bounds) held for `hold_periods` from the state that the stop left; held = x at the hold's end.
           (x0, x1) = x at the beginning and at the end of one period of it: drawn uniformly (`sampling.period = "random"`), or the first

The law pi of (x0, u): the hold begins where the stop leaves the robot inside the region; u uniform over those inputs whose hold cannot
leave the geofence from there (a disc of 1.1 times the commanded way; where the geofence is wider than the region by that much: all of
them). With a random period x0 is a state of the moving robot, as a controller meets it; the first period begins at rest and is
blind to whatever acts late. The heading at the hold's start, and on which side of its waypoint it lies, still depend on where the robot
came from; the long hold before is what makes that nearly as random as a fresh start, as in the paper.

Stamps (guarantee G7): a period counts if x1 was observed EARLY before one step after x0 or later, and no later than LATE after
it; with a model that does not step exactly at any length, within EARLY either way. It is compared with a step of its own length. Where
the period that was drawn is off, the next one of a random order counts: stamps decide, states do not. A hold ends by the same rule.
The commands before x0 are recorded, so that effects with memory begin with what the robot was commanded.

Whether a sample counts is settled by x0, u, stamps and the gate, never by a prediction: nothing here knows the model's, so no
rejection can depend on the discrepancy. The robot's own motion can cost a sample in one way only, by crossing the geofence, which
takes one that goes a tenth farther than commanded; those are counted under the gate's reason. One transition a hold (guarantee G7).

Every draw comes from (seed, epoch, index, run, try): a resumed campaign starts the sample anew with fresh numbers, so what
an interruption cut off is never repeated and the law is the same. Standard library and message structs only.
"""

from __future__ import annotations

import math
import random
from collections import deque
from collections.abc import Callable
from typing import Any, NamedTuple

import msgspec

from s2r_runtime.core import goto
from s2r_runtime.errors import ConfigError
from s2r_runtime.files.canonical import digest_of
from s2r_runtime.messages import GRID, RESTARTS, RULES, Observation, SampleTaken, Settings
from s2r_runtime.profile import Sampling, plain_table

Bounds = tuple[tuple[float, float], ...]

EARLY, LATE = 0.01, 0.2
"""Of dt: how much earlier and later than due x1 and the hold's end may be observed. A shorter transition would show less than a step's
discrepancy; a longer one shows no less, and is compared with a step of its own length. A period lost is 1.0 off.
"""
EARLY_BEFORE = 0.2
"""`EARLY` under rules before `GRID`: such a sample may be a fifth shorter than a step, and its gap too small."""
PAST_ROWS = 20
"""Commands before a hold that are recorded, at most: the stop is one, the approach has one a period."""
JITTER_PERIODS = 4
DRAWS = 1000
"""Inputs tried at one x0 until one's hold stays inside; the rarest admissible share met in practice is some percent."""
REACH_SLACK = 1.1
ATTEMPTS, NEARER = 5, 2.0
"""Waypoints in a row toward which the robot did not move, or in all its time came no nearer than by so many of their radii (what fell on
its back kicks), before it counts as stuck for good.
"""
STILL_S = 1.0
"""So long a robot begins to move in; after twice that without motion it is asked for twice as much, after three times for three times."""
PAUSE_S, PAUSE_PERIODS = 1.0, 2.5
"""Longer silences between observations, by both, are an interruption, not time that sampling takes. A period of a second is no silence."""


class CampaignStep(NamedTuple):
    """Answer to one observation. `u`: (nu,), what to command. `sample`: there when one was completed by this observation.

    `done`: all n samples are there. `failed`: not empty iff the campaign cannot go on, and why. Both stay so.
    """

    u: tuple[float, ...]
    phase: str
    sample: SampleTaken | None = None
    done: bool = False
    failed: str = ""


class Progress(NamedTuple):
    """How far it is. Times in the robot's seconds; `left_s`: None until a sample tells how long one takes."""

    phase: str
    taken: int
    n: int
    rejected: dict[str, int]
    elapsed_s: float
    left_s: float | None


class Snapshot(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What a campaign needs to go on after an interruption. `digest`: of what it was begun with."""

    digest: str
    index: int
    run: int
    rejected: dict[str, int]
    elapsed_ns: int


class Campaign:
    """Draws `n` independent transitions. region, geofence: bounds a state (angles may be bounded by their circle); dt in s.

    epoch, seed: name the draws. gains: of the go-to law. Raises ConfigError for a model without a go-to law, and where the
    settings leave no room for waypoints.
    """

    def __init__(
        self,
        model_name: str,
        states: tuple[str, ...],
        angles: tuple[str, ...],
        region: Bounds,
        geofence: Bounds,
        input_bounds: Bounds,
        dt: float,
        settings: Sampling,
        *,
        n: int,
        epoch: int,
        seed: int,
        gains: goto.Gains | None = None,
        rules: int = RULES,
        any_step: bool = False,
    ) -> None:
        self._on_grid, self._notes_restarts = rules >= GRID, rules >= RESTARTS
        self._early, self._late = (EARLY, LATE if any_step else EARLY) if rules >= GRID else (EARLY_BEFORE, EARLY_BEFORE)
        self._off = "off_step" if rules >= GRID else "lost_observation"
        self._random = rules >= GRID and settings.period == "random"
        self._model = model_name
        self._gains = gains or goto.Gains(settings.position_gain, settings.heading_gain)
        goto.distance(model_name, (0.0,) * len(states), (0.0, 0.0))  # the law must exist
        self._region, self._fence, self._bounds = region, geofence, input_bounds
        self._circles = {i for i, name in enumerate(states) if name in angles and region[i][1] - region[i][0] > 2.0 * math.pi - 1e-9}
        self._angles = [i for i, name in enumerate(states) if name in angles]
        self._settings, self._dt_ns, self._dt = settings, round(dt * 1e9), dt
        self._pause_ns = max(PAUSE_S * 1e9, PAUSE_PERIODS * self._dt_ns)
        self._n, self._epoch, self._seed = n, epoch, seed
        self._box = _waypoint_box(states, region, geofence, settings.waypoint_margin)
        self._guard = min(0.05, 0.5 * settings.waypoint_margin)
        self._zero = (0.0,) * len(input_bounds)
        law = [model_name, states, region, geofence, input_bounds, dt, plain_table("sampling", settings), n, epoch, seed, self._gains]
        self.digest = digest_of([*law, GRID, any_step] if rules >= GRID else law)  # rules since draw no otherwise: it goes on under them
        self._index = self._run = self._try = 0
        self._rejected: dict[str, int] = {}
        self._elapsed_ns, self._last_ns, self._last_seq = 0, -1, -1
        self._failed = ""
        self._refused, self._refusals, self._motionless = False, 0, 0
        self._held_u = self._zero
        self._mark: tuple[int, tuple[float, ...]] | None = None
        self._instants: list[Observation] = []
        self._apart_ns: list[int] = []
        self._commands: deque[tuple[int, tuple[float, ...]]] = deque(maxlen=PAST_ROWS)
        self._phases: dict[str, Callable[[Observation], CampaignStep]] = {"goto": self._goto, "stop": self._stop, "hold": self._hold}
        self._begin_try()

    @classmethod
    def from_settings(cls, settings: Settings, sampling: Sampling, *, n: int, epoch: int, seed: int) -> Campaign:
        """A campaign as the core's settings and the profile's `[sampling]` describe it."""
        return cls(
            settings.model_name,
            settings.states,
            settings.angles,
            settings.region,
            settings.geofence,
            settings.input_bounds,
            settings.dt_ns * 1e-9,
            sampling,
            n=n,
            epoch=epoch,
            seed=seed,
            rules=settings.rules,
            any_step=settings.any_step,
        )

    # ------------------------------------------------------------------ interruption

    def snapshot(self) -> dict[str, Any]:
        """Plain data to go on from. Take one when the campaign begins, after `restore`, and with every sample."""
        state = Snapshot(self.digest, self._index, self._run, dict(self._rejected), self._elapsed_ns)
        plain: dict[str, Any] = msgspec.to_builtins(state)
        return plain

    def restore(self, snapshot: dict[str, Any]) -> None:
        """Goes on from a snapshot, with fresh draws. Raises ConfigError if it is not of a campaign with these settings."""
        try:
            state = msgspec.convert(snapshot, Snapshot)
        except msgspec.ValidationError as error:
            raise ConfigError(f"campaign snapshot: {error}") from None
        if state.digest != self.digest:
            raise ConfigError("campaign snapshot: is of a campaign with other settings; begin a new one")
        self._index, self._run, self._rejected, self._elapsed_ns = state.index, state.run + 1, dict(state.rejected), state.elapsed_ns
        self._last_ns, self._last_seq, self._try, self._failed, self._refusals, self._motionless = -1, -1, 0, "", 0, 0
        self._begin_try()

    def progress(self) -> Progress:
        """Samples so far and the time that the others will take, at the pace so far."""
        left = self._elapsed_ns * 1e-9 * (self._n - self._index) / self._index if self._index else None
        return Progress(self._phase, self._index, self._n, dict(self._rejected), self._elapsed_ns * 1e-9, left)

    # ------------------------------------------------------------------ one period

    def step(self, observation: Observation) -> CampaignStep:
        """What to command in answer to this observation. One call a control instant, in the order of the stamps."""
        if self._failed or self._index >= self._n:
            return self._over()
        now = observation.stamp_ns
        if observation.seq < self._last_seq:
            self.restarted()
        self._last_seq = observation.seq
        if self._last_ns < 0:
            self._last_ns = self._began_ns = now
        if now < self._last_ns or now - self._last_ns > self._pause_ns:
            if self._phase == "hold":
                self._reject("interrupted")
            self._began_ns, self._mark = now, None
            self._commands.clear()
        else:
            self._elapsed_ns += now - self._last_ns
        self._last_ns = now
        if self._failed:
            return self._over()
        if observation.fault or len(observation.x) != len(self._region):
            return self._commanded(now, self._answer(self._held_u if self._phase == "hold" else self._zero))
        step = self._commanded(now, self._phases[self._phase](observation))
        self._refused = False
        return step

    def _commanded(self, now_ns: int, step: CampaignStep) -> CampaignStep:
        """Notes what acts from now on."""
        if not self._commands or self._commands[-1][1] != step.u:
            self._commands.append((now_ns, step.u))
        return step

    def restarted(self) -> None:
        """The robot started anew, or the link to it was lost or found: no sample spans that, and no command from before is its past."""
        if not self._notes_restarts or self._failed or self._index >= self._n:
            return
        if self._phase == "hold":
            self._reject("interrupted")
        self._commands.clear()
        self._mark, self._last_ns = None, -1  # a stop begins anew

    def refused(self, obs_seq: int, reason: str) -> None:
        """The gate refused the answer to that observation: another input acted, so the sample under way is lost.

        On the way to a waypoint nothing is lost, and a stop begins anew; but a gate that lets nothing through for `stuck_after`
        ends the campaign.
        """
        if self._failed or self._index >= self._n:
            return
        self._refused = True
        self._refusals += 1
        self._mark = None
        self._commands.clear()  # the recovery command acted, and the hold that follows begins after a new stop
        if self._phase == "hold":
            self._reject(reason)
        if self._refusals * self._dt >= self._settings.stuck_after and not self._failed:
            self._failed = f"the gate refuses the sampler ({reason}) since {self._refusals} periods, the last at observation {obs_seq}"

    # ------------------------------------------------------------------ phases

    def _begin_try(self) -> None:
        """Draws the next waypoint. Each try has random numbers of its own."""
        self._rng = random.Random(f"{self._seed}/{self._epoch}/{self._index}/{self._run}/{self._try}")
        self._try += 1
        self._waypoint = tuple(self._rng.uniform(low, high) for low, high in self._box)
        self._stop_periods = self._settings.stop_periods + self._rng.randrange(JITTER_PERIODS)
        self._phase = "goto"
        self._began_ns = self._last_ns
        self._held_u, self._mark, self._instants = self._zero, None, []
        self._standing: Observation | None = None
        self._before: tuple[float, ...] = ()
        self._way = math.inf

    def _goto(self, observation: Observation) -> CampaignStep:
        x, now = observation.x, observation.stamp_ns
        left = goto.distance(self._model, x, self._waypoint)
        self._way = left if math.isinf(self._way) else self._way
        if left <= self._settings.waypoint_radius:
            self._phase, self._began_ns, self._motionless = "stop", now, 0
            return self._answer(self._zero)
        if now - self._began_ns > self._settings.waypoint_timeout * 1e9:
            came = self._way - left > NEARER * self._settings.waypoint_radius
            return self._again("timeout", observation) if came else self._nowhere("timeout", observation)
        u = goto.go_to(self._model, x, self._waypoint, self._bounds, self._gains)
        if self._mark is None or self._moved(self._mark[1], x) or not any(u):
            self._mark = (now, x)
        elif now - self._mark[0] > self._settings.stuck_after * 1e9:
            return self._nowhere("stuck", observation)
        if any(u):
            u = self._pressed(u, now - self._mark[0])
        return self._answer(goto.confined(self._model, x, u, self._fence[:2], self._guard))

    def _nowhere(self, reason: str, observation: Observation) -> CampaignStep:
        """Another waypoint, unless the robot got nowhere too often."""
        self._motionless += 1
        if self._motionless < ATTEMPTS:
            return self._again(reason, observation)
        s, at = self._settings, _point(observation.x)
        self._failed = (
            f"stuck: commanded for {ATTEMPTS * s.stuck_after:g} s toward {ATTEMPTS} waypoints, the robot did not move from {at}"
            if reason == "stuck"
            else f"stuck: {ATTEMPTS} waypoints in a row were not reached, the last from {at}; in {s.waypoint_timeout:g} s "
            "the robot came hardly nearer"
        )
        return self._over()

    def _pressed(self, u: tuple[float, ...], still_ns: int) -> tuple[float, ...]:
        """As many times u as the robot has stood still for STILL_S, as far as the bounds allow."""
        used = max(value / (high if value > 0.0 else low) for value, (low, high) in zip(u, self._bounds, strict=True) if value)
        factor = min(still_ns * 1e-9 / STILL_S, 1.0 / used)
        return (
            u if factor <= 1.0 else tuple(min(max(factor * value, low), high) for value, (low, high) in zip(u, self._bounds, strict=True))
        )

    def _stop(self, observation: Observation) -> CampaignStep:
        before, self._standing = self._standing, observation
        if self._refused:
            self._began_ns = observation.stamp_ns
        if observation.stamp_ns - self._began_ns < (self._stop_periods - 0.5) * self._dt_ns:
            return self._answer(self._zero)
        if not self._inside(observation.x, self._region):
            return self._again("outside_region", observation)
        u = self._draw_input(observation.x)
        if u is None:
            return self._again("outside_geofence", observation)
        self._phase, self._began_ns, self._held_u, self._instants = "hold", observation.stamp_ns, u, [observation]
        if before is not None and abs(observation.stamp_ns - before.stamp_ns - self._dt_ns) <= EARLY_BEFORE * self._dt_ns:
            self._before = before.x
        self._order = self._rng.sample(range(periods := self._settings.hold_periods), periods) if self._random else [0]
        return self._answer(u)

    def _hold(self, observation: Observation) -> CampaignStep:
        since, dt, periods = observation.stamp_ns - self._began_ns, self._dt_ns, self._settings.hold_periods
        first = len(self._instants) == 1
        if self._random or (first and since >= dt - self._early * dt):
            self._instants.append(observation)
        if first:
            self._apart_ns = [*self._apart_ns[-9:], since]
        if first and not self._random and since > dt + self._late * dt:
            return self._again(self._off, observation)
        if since < periods * dt - self._early * dt:
            return self._answer(self._held_u)
        most = periods + self._late + (1.0 if self._late > self._early else 0.0)  # the last instant may come too early for an end
        chosen = next((j for j in self._order if self._is_step(j)), None)
        if since > most * dt or chosen is None:
            return self._again(self._off, observation)
        return self._take(observation, chosen)

    def _is_step(self, j: int) -> bool:
        """Whether instants j and j + 1 of the hold are one step apart, by their stamps."""
        if j + 1 >= len(self._instants):
            return False
        lasts = self._instants[j + 1].stamp_ns - self._instants[j].stamp_ns
        return -self._early * self._dt_ns <= lasts - self._dt_ns <= self._late * self._dt_ns

    def _take(self, observation: Observation, chosen: int) -> CampaignStep:
        """The hold is over: one sample more. The same observation begins the way to the next waypoint."""
        start, x0, x1 = self._instants[0], self._instants[chosen], self._instants[chosen + 1]
        periods = self._settings.hold_periods
        sample = SampleTaken(
            t_ns=observation.stamp_ns,
            epoch=self._epoch,
            index=self._index,
            obs_seq0=x0.seq,
            t0_ns=x0.stamp_ns,
            u=self._held_u,
            x0=x0.x,
            x1=x1.x,
            held=observation.x if periods > 1 else (),
            periods=periods,
            before=self._before,
        )
        if self._on_grid:
            past = [(begin, u) for begin, u in self._commands if begin < start.stamp_ns]
            ends = [*(begin for begin, _ in past[1:]), start.stamp_ns][: len(past)]
            sample = msgspec.structs.replace(
                sample,
                lasts_ns=x1.stamp_ns - x0.stamp_ns,
                period=chosen,
                start=start.x,
                start_seq=start.seq,
                start_ns=start.stamp_ns,
                hold_ns=observation.stamp_ns - start.stamp_ns if periods > 1 else 0,
                past_u=tuple(u for _, u in past),
                past_ns=tuple(end - begin for (begin, _), end in zip(past, ends, strict=True)),
            )
        self._index, self._try, self._refusals = self._index + 1, 0, 0
        self._begin_try()
        following = self._over() if self._index >= self._n else self._goto(observation)
        return following._replace(sample=sample)

    # ------------------------------------------------------------------ small parts

    def _answer(self, u: tuple[float, ...]) -> CampaignStep:
        if not self._refused:
            self._refusals = 0
        return CampaignStep(u, self._phase)

    def _over(self) -> CampaignStep:
        return CampaignStep(self._zero, "over", None, self._index >= self._n, self._failed)

    def _reject(self, reason: str) -> None:
        """Counts, and begins the sample anew elsewhere; too many end the campaign."""
        self._rejected[reason] = self._rejected.get(reason, 0) + 1
        total, most = sum(self._rejected.values()), self._settings.max_rejections
        if total > most:
            counts = ", ".join(f"{name} {count}" for name, count in sorted(self._rejected.items()))
            self._failed = f"more than {most} samples were rejected after {self._index} of {self._n}: {counts}"
            if 2 * self._rejected.get("off_step", 0) > total and self._apart_ns:
                apart = sorted(self._apart_ns)[len(self._apart_ns) // 2] * 1e-9
                early, late = 100.0 * self._early, 100.0 * self._late
                self._failed += (
                    f"; off_step: observations that should end a step come {apart:.6g} s after its beginning, the model's step is "
                    f"{self._dt:g} s (-{early:g} %, +{late:g} %): let the robot report a whole number of times a step"
                )
        self._begin_try()

    def _again(self, reason: str, observation: Observation) -> CampaignStep:
        self._reject(reason)
        return self._over() if self._failed else self._goto(observation)

    def _draw_input(self, x: tuple[float, ...]) -> tuple[float, ...] | None:
        """Uniform over the inputs whose hold stays inside the geofence from x; None if there is hardly any."""
        room = min(min(x[axis] - low, high - x[axis]) for axis, (low, high) in enumerate(self._fence[:2]))
        duration = self._settings.hold_periods * self._dt
        for _ in range(DRAWS):
            u = tuple(self._rng.uniform(low, high) for low, high in self._bounds)
            if REACH_SLACK * goto.reach(self._model, x, u, duration, self._gains) <= room:
                return u
        return None

    def _inside(self, x: tuple[float, ...], bounds: Bounds) -> bool:
        return all(i in self._circles or low <= x[i] <= high for i, (low, high) in enumerate(bounds))

    def _moved(self, a: tuple[float, ...], b: tuple[float, ...]) -> bool:
        """A tenth of the waypoint's radius, or as many radians of turn: far above noise, far below a period's worth of stuck_after."""
        turn = max((abs(math.remainder(b[i] - a[i], 2.0 * math.pi)) for i in self._angles), default=0.0)
        return max(math.hypot(b[0] - a[0], b[1] - a[1]) / self._settings.waypoint_radius, turn) > 0.1


def _waypoint_box(states: tuple[str, ...], region: Bounds, fence: Bounds, margin: float) -> Bounds:
    """Where waypoints are drawn: the two position axes, `margin` inside of region and geofence."""
    box = tuple((max(region[i][0], fence[i][0]) + margin, min(region[i][1], fence[i][1]) - margin) for i in (0, 1))
    for name, (low, high) in zip(states, box, strict=False):
        if not low < high:
            raise ConfigError(
                f"sampling.waypoint_margin is {margin} m: it leaves no room for waypoints along {name!r} in region and geofence"
            )
    return box


def _point(x: tuple[float, ...]) -> str:
    return f"({x[0]:.2f}, {x[1]:.2f}) m"
