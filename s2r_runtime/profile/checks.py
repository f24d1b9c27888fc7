"""What the settings of a profile may be, table by table. A check says whether it holds, of which field, its value, and what that must be.

Names (of states, inputs, effects, tasks) are checked where the model is composed: `profile.check_model`.
"""

from __future__ import annotations

import difflib
import math
import re
from collections.abc import Iterator
from itertools import chain
from typing import TYPE_CHECKING

from s2r_runtime.gate import REASONS

if TYPE_CHECKING:
    from s2r_runtime.profile.settings import (
        Driving,
        Gate,
        Machine,
        Profile,
        Recording,
        Recovery,
        Repair,
        Robot,
        Sampling,
        VerificationSettings,
        Watch,
    )

SHORTEST_S, LONGEST_S = 1e-9, 1e9
"""Times are kept in whole nanoseconds of 64 bits: no less than one, and 1e9 s (some 30 years) is well below what fits."""

LIGHTEST, HEAVIEST = 1e-30, 1e30
"""Weights of a state in the norm. Beyond, squares overflow or vanish, and with them what a state has to say."""

Check = tuple[bool, str, object, str]


def problems(p: Profile) -> Iterator[tuple[str, object, str]]:
    """(field, value, what it must be) of every setting out of its range, table by table."""
    checks = chain(
        _robot(p.robot),
        _model(p.model.dt),
        _bounds(p),
        _norm(p.norm.weights),
        _probabilities(p),
        _sampling(p.sampling),
        _driving(p.driving, p.model.dt),
        _verification(p.verification),
        _gate(p.gate),
        _recovery(p.recovery, p.inputs),
        _home(p),
        _watch(p.watch),
        _recording(p.recording),
        _machine(p.machine),
        _repair(p.repair),
        _rest(p),
    )
    return ((field, value, must) for ok, field, value, must in checks if not ok)


def _robot(robot: Robot) -> Iterator[Check]:
    plain = re.fullmatch(r"[a-z0-9][a-z0-9_-]*", robot.name) is not None
    yield plain, "robot.name", repr(robot.name), "lower-case letters, digits, - and _"


def _model(dt: float) -> Iterator[Check]:
    yield SHORTEST_S <= dt <= LONGEST_S, "model.dt", dt, "a nanosecond to 1e9 s"


def _bounds(p: Profile) -> Iterator[Check]:
    for table, bounds in (("region", p.region), ("inputs", p.inputs), ("geofence", p.geofence)):
        for name, (low, high) in bounds.items():
            ok = math.isfinite(low) and math.isfinite(high) and low < high
            yield ok, f"{table}.{name}", [low, high], "[low, high] with low < high, finite"
    for name, (low, high) in p.inputs.items():
        yield low <= 0.0 <= high, f"inputs.{name}", [low, high], "an interval around 0 (zero input stops the robot)"


def _norm(weights: dict[str, float]) -> Iterator[Check]:
    for name, weight in weights.items():
        yield LIGHTEST <= weight <= HEAVIEST, f"norm.weights.{name}", weight, f"> 0 and finite, from {LIGHTEST:g} to {HEAVIEST:g}"


def _probabilities(p: Profile) -> Iterator[Check]:
    g = p.guarantee
    for field, value in (
        ("guarantee.epsilon", g.epsilon),
        ("guarantee.beta", g.beta),
        ("guarantee.alpha", g.alpha),
        ("guarantee.beta_episodes", g.beta_episodes),
        ("guarantee.beta_composition", g.beta_composition),
        ("verification.epsilon", p.verification.epsilon),
    ):
        yield 0.0 < value < 1.0, field, value, "between 0 and 1"
    yield g.discard >= 0, "guarantee.discard", g.discard, ">= 0"
    yield 0.0 <= g.max_unsafe < 1.0, "guarantee.max_unsafe", g.max_unsafe, "0 (no such limit) to less than 1"


def _sampling(s: Sampling) -> Iterator[Check]:
    yield s.n >= 0, "sampling.n", s.n, ">= 0 (0: as many as beta asks for)"
    yield s.hold_periods >= 1, "sampling.hold_periods", s.hold_periods, ">= 1"
    yield s.stop_periods >= 1, "sampling.stop_periods", s.stop_periods, ">= 1, and at least the robot's delay + 1"
    for field, value in (
        ("waypoint_radius", s.waypoint_radius),
        ("waypoint_timeout", s.waypoint_timeout),
        ("position_gain", s.position_gain),
        ("heading_gain", s.heading_gain),
        ("stuck_after", s.stuck_after),
    ):
        yield 0.0 < value < math.inf, f"sampling.{field}", value, "> 0"
    yield s.waypoint_margin >= 0.0, "sampling.waypoint_margin", s.waypoint_margin, ">= 0 m"
    yield s.max_rejections >= 0, "sampling.max_rejections", s.max_rejections, ">= 0"
    yield s.seed >= 0, "sampling.seed", s.seed, ">= 0"  # scenarios of a drive are drawn with it as it is


def _driving(d: Driving, dt: float) -> Iterator[Check]:
    whole = d.block == 0.0 or 2.0 * dt <= d.block < math.inf
    yield whole, "driving.block", d.block, "0 (driving founds no gap) or two steps and more, s"
    yield 0.0 <= d.mixing < 1.0, "driving.mixing", d.mixing, "a bound on the beta-mixing coefficient, 0 to 1"
    reasoned = (d.block > 0.0) == bool(d.because.strip())
    yield reasoned, "driving.because", repr(d.because), "the reason why blocks mix, if and only if there are blocks"


def _verification(v: VerificationSettings) -> Iterator[Check]:
    yield v.n >= 0, "verification.n", v.n, ">= 0 (0: as many as beta asks for)"
    yield 1.0 <= v.headroom < math.inf, "verification.headroom", v.headroom, ">= 1"
    yield math.isfinite(v.threshold), "verification.threshold", v.threshold, "finite"
    among = bool(v.required) and set(v.required) <= set(v.laws)
    yield among, "verification.required", list(v.required), "at least one of verification.laws"
    yield 0.0 < v.max_optimism <= 1.0, "verification.max_optimism", v.max_optimism, "above 0 and at most 1 (1: no demand)"
    yield 0.0 <= v.run_radius < math.inf, "verification.run_radius", v.run_radius, "0 (none is meant) or above, in the norm's unit"
    yield _lasting(v.timeout), "verification.timeout", v.timeout, "> 0 s and at most 1e9 s"


def _gate(g: Gate) -> Iterator[Check]:
    for field, value in (
        ("observation_timeout", g.observation_timeout),
        ("command_ttl", g.command_ttl),
        ("controller_deadline", g.controller_deadline),
    ):
        yield _lasting(value), f"gate.{field}", value, "> 0 s and at most 1e9 s"
    yield 0.0 <= g.hysteresis <= LONGEST_S, "gate.hysteresis", g.hysteresis, ">= 0 s and at most 1e9 s"
    yield g.settle_periods >= 0, "gate.settle_periods", g.settle_periods, ">= 0"
    yield 0.0 <= g.fault_share <= 1.0, "gate.fault_share", g.fault_share, "between 0 (no such bound) and 1"
    yield 0 <= g.fault_burst <= 1_000_000, "gate.fault_burst", g.fault_burst, "0 to 1e6"
    for reason in g.latching:  # a misspelt one would never latch
        near = difflib.get_close_matches(reason, REASONS, 1, 0.6)
        must = "one of the gate's reasons" + (f"; did you mean {near[0]!r}?" if near else "")
        yield reason in REASONS, "gate.latching", repr(reason), must


def _recovery(recovery: Recovery, inputs: dict[str, tuple[float, float]]) -> Iterator[Check]:
    """What is held to recover stays in the input bounds: a command beyond them would go out as another one than is written here."""
    for name, value in recovery.input.items() if recovery.kind == "hold" else ():
        low, high = inputs.get(name, (-math.inf, math.inf))
        yield low <= value <= high, f"recovery.input.{name}", value, f"in inputs.{name}: {low:g} to {high:g}"


def _home(p: Profile) -> Iterator[Check]:
    """Where recovery drives to is inside the fence: on its way there the gate is closed already, and nothing else would stop the robot."""
    for name, (low, high) in {**p.region, **p.geofence}.items() if p.recovery.kind == "return" else ():
        at = p.recovery.home.get(name, 0.0)
        fence = "geofence" if name in p.geofence else "region"
        yield low <= at <= high, f"recovery.home.{name}", at, f"in {fence}.{name}: {low:g} to {high:g} (a state left out is 0)"


def _watch(w: Watch) -> Iterator[Check]:
    yield 1.0 <= w.run_length <= 1e12, "watch.run_length", w.run_length, "1 to 1e12 discrepancies"
    yield w.fault_jump >= 0.0, "watch.fault_jump", w.fault_jump, ">= 0 (0: it follows from the geofence)"
    yield w.max_faults >= 0, "watch.max_faults", w.max_faults, ">= 0"


def _recording(r: Recording) -> Iterator[Check]:
    for field, value in (("rotate_bytes", r.rotate_bytes), ("rotate_after", r.rotate_after)):
        yield value >= 0, f"recording.{field}", value, ">= 0 (0: no rotation by it)"
    for field, value in (("keep_bytes", r.keep_bytes), ("keep_days", r.keep_days)):
        yield value >= 0, f"recording.{field}", value, ">= 0 (0: all logs are kept)"
    yield 0.1 <= r.max_delay <= LONGEST_S, "recording.max_delay", r.max_delay, "0.1 s at least (a chunk is written every 0.05 s)"


def _machine(m: Machine) -> Iterator[Check]:
    """The service manager ends a daemon whose loop stands still for 10 s (WatchdogSec of the unit)."""
    yield (
        0.1 <= m.disk_timeout < 10.0,
        "machine.disk_timeout",
        m.disk_timeout,
        "0.1 s to less than 10 s: the gate's loop stands still for it",
    )
    yield 0.1 <= m.process_timeout <= LONGEST_S, "machine.process_timeout", m.process_timeout, "0.1 to 1e9 s"
    yield 0.1 <= m.watch_delay <= m.process_timeout, "machine.watch_delay", m.watch_delay, "0.1 s to machine.process_timeout"
    yield _lasting(m.start_timeout), "machine.start_timeout", m.start_timeout, "> 0 s and at most 1e9 s"


def _repair(r: Repair) -> Iterator[Check]:
    yield 0.0 <= r.delay <= LONGEST_S, "repair.delay", r.delay, ">= 0 s and at most 1e9 s"
    yield r.rows >= 100, "repair.rows", r.rows, ">= 100 (a trace needs some dozens of transitions)"
    yield _lasting(r.timeout), "repair.timeout", r.timeout, "> 0 s and at most 1e9 s"


def _rest(p: Profile) -> Iterator[Check]:
    yield 1.0 <= p.certificate.lifetime <= LONGEST_S, "certificate.lifetime", p.certificate.lifetime, ">= 1 s and at most 1e9 s"
    yield p.task.episodes >= 0, "task.episodes", p.task.episodes, ">= 0 (0: no end)"
    name = p.transport.get("name")
    yield not p.transport or isinstance(name, str), "transport.name", name, "the name of a transport"


def _lasting(time_s: float) -> bool:
    return 0.0 < time_s <= LONGEST_S
