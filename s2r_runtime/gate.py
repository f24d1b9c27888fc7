"""The gate: may this command move the robot now? (docs/gate.md)

    verdict = decide(settings, situation, command, now_ns)

Pure, standard library and message structs only. It denies by default: every condition is a reason not to, in the order of
`REASONS`, and the one ALLOW stands after all of them. Nothing that was checked before is trusted: numbers are tested for
finiteness again, NaN fails every comparison on the closed side. Time is integer nanoseconds; a clock that runs backward is closed.

Two sources can pass, under different conditions: the controller (certificate) and the sampler (permit). The recovery command is
not decided here, it is what goes out instead; everybody else is refused. docs/gate.md says what each reason means.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from s2r_runtime.messages import CertificateFacts, Command, Observation, Settings, Source, Struct

REASONS: tuple[str, ...] = (
    # ------------------------------ whoever commands
    "source_not_allowed",
    "not_started",
    "memory_refused",
    "stopping",
    "emergency_stop",
    "manual_override",
    "robot_twin",
    "observation_faults",
    "clock_backwards",
    "recorder_down",
    "link_down",
    "latched",  # as `latched:<reason>`
    # ------------------------------ the sampler
    "no_permit",
    "permit_expired",
    "campaign_not_running",
    # ------------------------------ the controller
    "controller_fault",
    "verification_running",
    "no_controller",
    "analytics_down",
    "watch_alarm",
    "certificate_revoked",
    "no_certificate",
    "certificate_expired",
    "digest_mismatch",
    "radius_above_verified",
    "measurement_faults",
    # ------------------------------ where the robot is
    "observation_invalid",
    "observation_out_of_order",
    "observation_missing",
    "observation_stale",
    "outside_region",
    "outside_geofence",
    # ------------------------------ the command itself
    "command_invalid",
    "command_out_of_order",
    "command_stale",
    "input_out_of_bounds",
    "settling",
)
"""Every reason why the gate can be closed."""

ALWAYS_LATCHING = ("emergency_stop", "manual_override", "robot_twin", "observation_faults")
"""These latch whatever the profile says, hold back every source, and leave nothing but zero input (docs/gate.md)."""

LATCH_HOLDS_ALL = (*ALWAYS_LATCHING, "recorder_down", "link_down", "clock_backwards", "measurement_faults", "outside_geofence")
"""Latched, these hold back the sampler too. The others are about the controller; sampling anew may be their remedy."""

ABOUT_COMMAND = ("command_invalid", "command_out_of_order", "command_stale", "input_out_of_bounds")
"""Refusals that are the controller's own doing; they latch, where the profile says so, even if the gate was closed already."""

ALLOWED = "allowed"
NO_NUMBER = -1.0
"""Margin of a refusal that has no number to it."""
CLOCK_SKEW_S = 300
"""A wall clock this much before a certificate's issue is wrong, and then nobody can tell whether the certificate expired."""
_MAX = 1.7976931348623157e308


class Situation(Struct, frozen=True):
    """What the gate looks at, besides the profile's settings and the command. The defaults are those of a closed gate.

    unix_s: the wall clock now. asked_seq, asked_ns: the observation that the command must answer and when that was asked for.
    clear_since_ns: since when all standing conditions of the controller hold.
    """

    clock_ns: int = 0
    unix_s: int = 0
    stopping: bool = False
    latched: tuple[str, ...] = ()
    recorder_ok: bool = False
    link_up: bool = False
    permit_until_ns: int | None = None
    campaign_running: bool = False
    controller_digest: str | None = None
    analytics_up: bool = False
    alarmed: bool = False
    verifying: bool = False
    certificate: CertificateFacts | None = None
    revoked: bool = False
    model_digest: str = ""
    epoch: int = 0
    radius: float = math.inf
    faults: int = 0
    observation: Observation | None = None
    observation_ns: int = 0
    trouble: str = ""
    asked_seq: int | None = None
    asked_ns: int = 0
    last_command_seq: int = -1
    clear_since_ns: int | None = None


class Verdict(NamedTuple):
    """`margin`: how far outside the failing bound (< 0), in its unit; allowed: distance of the state from the bound of the
    region (controller) or geofence (sampler).
    """

    allow: bool
    reason: str
    margin: float


def decide(settings: Settings, situation: Situation, command: Command, now_ns: int) -> Verdict:
    """The verdict on one command."""
    if command.source not in ("controller", "sampler"):
        return _refuse("source_not_allowed")
    refusal = standing(settings, situation, command.source, now_ns) or _about_command(settings, situation, command, now_ns)
    if refusal is not None:
        return refusal
    if command.source == "controller":
        if situation.clear_since_ns is None:
            return _refuse("settling")
        if not now_ns - situation.clear_since_ns >= settings.hysteresis_ns:
            return _refuse("settling", (now_ns - situation.clear_since_ns - settings.hysteresis_ns) * 1e-9)
    bounds = settings.region if command.source == "controller" else settings.geofence
    x = situation.observation.x if situation.observation is not None else ()
    return Verdict(allow=True, reason=ALLOWED, margin=inside(settings, x, bounds))


def standing(settings: Settings, situation: Situation, source: Source, now_ns: int) -> Verdict | None:
    """The first reason why no command of this source can pass at the moment, whatever it is; None if there is none."""
    return (
        _about_everybody(situation, now_ns)
        or (_about_controller(settings, situation) if source == "controller" else _about_sampler(situation, now_ns))
        or _about_observation(settings, situation, source, now_ns)
    )


def _about_everybody(s: Situation, now_ns: int) -> Verdict | None:
    if s.stopping:
        return _refuse("stopping")
    for reason in ALWAYS_LATCHING:
        if reason in s.latched:
            return _refuse(reason)
    if now_ns < s.clock_ns:
        return _refuse("clock_backwards", (now_ns - s.clock_ns) * 1e-9)
    if not s.recorder_ok:
        return _refuse("recorder_down")
    if not s.link_up:
        return _refuse("link_down")
    return None


def _about_sampler(s: Situation, now_ns: int) -> Verdict | None:
    for reason in s.latched:
        if reason in LATCH_HOLDS_ALL:
            return _refuse(f"latched:{reason}")
    if s.permit_until_ns is None:
        return _refuse("no_permit")
    if not now_ns < s.permit_until_ns:
        return _refuse("permit_expired", (s.permit_until_ns - now_ns) * 1e-9)
    if not s.campaign_running:
        return _refuse("campaign_not_running")
    return None


def _about_controller(settings: Settings, s: Situation) -> Verdict | None:
    for reason in s.latched:
        return _refuse(f"latched:{reason}")
    if s.controller_digest is None:
        return _refuse("verification_running" if s.verifying else "no_controller")
    if not s.analytics_up:
        return _refuse("analytics_down")
    if s.alarmed:
        return _refuse("watch_alarm")
    return about_certificate(settings, s) or _about_watch(settings, s)


def about_certificate(settings: Settings, s: Situation) -> Verdict | None:
    """The first reason why this certificate does not cover this controller, model, task, profile, epoch and radius now."""
    c = s.certificate
    if s.revoked:
        return _refuse("certificate_revoked")
    if c is None:
        return _refuse("no_certificate")
    if not s.unix_s < c.expires_unix_s:
        return _refuse("certificate_expired", float(c.expires_unix_s - s.unix_s))
    if not s.unix_s >= c.issued_unix_s - CLOCK_SKEW_S:
        return _refuse("certificate_expired", float(s.unix_s - c.issued_unix_s))
    if (
        not c.controller_digest
        or c.controller_digest != s.controller_digest
        or c.model_digest != s.model_digest
        or c.task_digest != settings.task_digest
        or c.profile_digest != settings.profile_digest
        or c.epoch != s.epoch
    ):
        return _refuse("digest_mismatch")
    if not (finite(s.radius) and finite(c.verified_radius) and s.radius <= c.verified_radius):
        return _refuse("radius_above_verified", c.verified_radius - s.radius)
    return None


def _about_watch(settings: Settings, s: Situation) -> Verdict | None:
    if s.verifying:
        return _refuse("verification_running")
    if not s.faults <= settings.max_measurement_faults:
        return _refuse("measurement_faults", float(settings.max_measurement_faults - s.faults))
    return None


def _about_observation(settings: Settings, s: Situation, source: Source, now_ns: int) -> Verdict | None:
    if s.trouble:
        return _refuse(s.trouble)
    observation = s.observation
    if observation is None:
        return _refuse("observation_missing")
    if observation.fault or len(observation.x) != len(settings.states) or not all(map(finite, observation.x)):
        return _refuse("observation_invalid")
    age_ns = now_ns - s.observation_ns
    if not 0 <= age_ns <= settings.observation_timeout_ns:
        return _refuse("observation_stale", _late(age_ns, settings.observation_timeout_ns))
    bounds, reason = (settings.region, "outside_region") if source == "controller" else (settings.geofence, "outside_geofence")
    margin = inside(settings, observation.x, bounds)
    return None if margin >= 0.0 else _refuse(reason, margin)


def _about_command(settings: Settings, s: Situation, command: Command, now_ns: int) -> Verdict | None:
    if command.fault or len(command.u) != len(settings.inputs) or not all(map(finite, command.u)):
        return _refuse("command_invalid")
    if command.obs_seq != s.asked_seq or command.seq <= s.last_command_seq:  # nobody asked: no number is None
        return _refuse("command_out_of_order")
    ttl_ns = min(command.ttl_ns, settings.command_ttl_ns)
    for since_ns in (command.t_ns, s.asked_ns):
        age_ns = now_ns - since_ns
        if not 0 <= age_ns <= ttl_ns:
            return _refuse("command_stale", _late(age_ns, ttl_ns))
    margin = _least([_slack(value, low, high) for value, (low, high) in zip(command.u, settings.input_bounds, strict=False)])
    if len(settings.input_bounds) != len(command.u) or margin < 0.0:
        return _refuse("input_out_of_bounds", margin)
    return None


def inside(settings: Settings, x: tuple[float, ...], bounds: tuple[tuple[float, float], ...]) -> float:
    """Least distance of a state from its bounds, negative outside. An angle is measured from the middle of its bounds, wrapped;
    bounds a circle apart are none.
    """
    if len(bounds) != len(x) or len(settings.states) != len(x):
        return NO_NUMBER
    slacks = []
    for name, value, (low, high) in zip(settings.states, x, bounds, strict=True):
        if name not in settings.angles:
            slacks.append(_slack(value, low, high))
        elif not high - low >= 2.0 * math.pi:
            middle = low + 0.5 * (high - low)
            off = math.remainder(value - middle, 2.0 * math.pi) if finite(middle) else math.nan
            slacks.append(_slack(off, low - middle, high - middle))
    return _least(slacks)


def _late(age_ns: int, limit_ns: int) -> float:
    """Seconds beyond the limit, or from the future; negative."""
    return (limit_ns - age_ns if age_ns >= 0 else age_ns) * 1e-9


def _slack(value: float, low: float, high: float) -> float:
    """Distance from the nearer bound, negative outside; a NaN anywhere is outside."""
    slack = min(value - low, high - value)
    return slack if low <= value <= high or slack < 0.0 else NO_NUMBER


def _least(slacks: list[float]) -> float:
    """The least, 0 if there are none, as a number that JSON can hold."""
    return max(-_MAX, min([_MAX, *slacks])) if slacks else 0.0


def finite(value: float) -> bool:
    """Whether it is a number with a finite float (an int may be too big to have one); NaN and inf fail the comparison."""
    return isinstance(value, int | float) and -_MAX <= value <= _MAX


def _refuse(reason: str, margin: float = NO_NUMBER) -> Verdict:
    return Verdict(allow=False, reason=reason, margin=max(-_MAX, margin) if margin < 0.0 else NO_NUMBER)
