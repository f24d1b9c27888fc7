"""docs/gate.md's table of reasons written down once more: each reason alone, in the order that the document gives them.

Nothing here is taken from the gate but the situation it is asked about. `reason` says what the verdict must be.
"""

from __future__ import annotations

import math
import random
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
from hostile import MAX, spoiled

from s2r_runtime.gate import Situation
from s2r_runtime.messages import CertificateFacts, Command, Observation, Settings

S = 1_000_000_000
NOW = 100 * S
DOCUMENT = Path(__file__).parents[2] / "docs" / "gate.md"

SETTINGS = Settings(
    robot="r",
    states=("x", "y", "theta"),
    inputs=("v", "w"),
    angles=("theta",),
    dt_ns=33_000_000,
    lockstep=False,
    region=((-1.6, 1.6), (-1.0, 1.0), (-math.pi, math.pi)),
    geofence=((-2.0, 2.0), (-1.5, 1.5), (-math.pi, math.pi)),
    input_bounds=((-0.2, 0.2), (-3.0, 3.0)),
    observation_timeout_ns=S // 5,
    command_ttl_ns=S // 10,
    hysteresis_ns=S // 10,
    settle_periods=30,
    latching=("controller_fault", "watch_alarm"),
    recovery="stop",
    recovery_input=(0.0, 0.0),
    home=(0.0, 0.0, 0.0),
    model_name="unicycle",
    model_digest="model",
    task_digest="task",
    profile_digest="profile",
    epsilon=0.03,
    beta=0.05,
    discard=0,
    campaign_n=0,
    headroom=1.5,
    alpha=0.01,
    max_measurement_faults=3,
    certificate_lifetime_s=1000,
    seed=1,
)
CERTIFICATE = CertificateFacts("c1", "controller", "model", "task", "profile", 1, 0.01, 0.015, issued_unix_s=1000, expires_unix_s=2000)
OPEN = Situation(
    clock_ns=NOW,
    unix_s=1500,
    recorder_ok=True,
    link_up=True,
    permit_until_ns=NOW + S,
    campaign_running=True,
    controller_digest="controller",
    analytics_up=True,
    certificate=CERTIFICATE,
    model_digest="model",
    epoch=1,
    radius=0.012,
    observation=Observation(7, 7, (1.0, 0.5, 1.0)),
    observation_ns=NOW - S // 100,
    asked_seq=7,
    asked_ns=NOW - S // 100,
    last_command_seq=3,
    clear_since_ns=NOW - S,
)
COMMAND = Command(4, NOW, "controller", (0.1, -1.0), 7, S // 10)


# ---------------------------------------------------------------- the law


def table() -> tuple[str, ...]:
    """The reasons in the order of the document's rows."""
    return tuple(re.findall(r"^\| `([a-z_]+)` \|.*\|.*\|.*\|$", DOCUMENT.read_text(encoding="utf-8"), re.MULTILINE))


def holds_all() -> tuple[str, ...]:
    """The latched reasons that the document says hold back the sampler too."""
    (sentence,) = re.findall(r"Latched, these hold back the sampler too: ([^.]*)\.", DOCUMENT.read_text(encoding="utf-8"))
    return tuple(re.findall(r"`([a-z_]+)`", sentence))


def number(value: Any) -> bool:
    """A number that a float can hold."""
    return isinstance(value, int | float) and abs(value) <= MAX


def within(name: str, value: float, low: float, high: float, angles: tuple[str, ...]) -> bool:
    """Inside of its bounds; on the circle if it is an angle."""
    if name not in angles:
        return low <= value <= high
    if high - low >= 2.0 * math.pi:
        return True
    middle = 0.5 * (low + high)
    if not number(middle):
        return False
    off = value - middle
    return abs(math.atan2(math.sin(off), math.cos(off))) <= 0.5 * (high - low)


def _unusable(observation: Observation | None, settings: Settings) -> bool:
    if observation is None:
        return False
    return bool(observation.fault) or len(observation.x) != len(settings.states) or not all(map(number, observation.x))


def _outside(bounds: str) -> Callable[..., bool]:
    def so(s: Settings, w: Situation, c: Command, now: int) -> bool:
        limits = getattr(s, bounds)
        if w.observation is None or _unusable(w.observation, s):
            return False
        if len(limits) != len(s.states):
            return True
        return not all(within(n, x, low, high, s.angles) for n, x, (low, high) in zip(s.states, w.observation.x, limits, strict=True))

    return so


def _mismatch(s: Settings, w: Situation, c: Command, now: int) -> bool:
    f = w.certificate
    if f is None:
        return False
    same = (f.controller_digest, f.model_digest, f.task_digest, f.profile_digest, f.epoch)
    return same != (w.controller_digest, w.model_digest, s.task_digest, s.profile_digest, w.epoch) or f.controller_digest == ""


def _expired(s: Settings, w: Situation, c: Command, now: int) -> bool:
    return w.certificate is not None and not w.certificate.issued_unix_s - 300 <= w.unix_s < w.certificate.expires_unix_s


def _outgrown(s: Settings, w: Situation, c: Command, now: int) -> bool:
    f = w.certificate
    return f is not None and not (number(w.radius) and number(f.verified_radius) and w.radius <= f.verified_radius)


def _command_invalid(s: Settings, w: Situation, c: Command, now: int) -> bool:
    return bool(c.fault) or len(c.u) != len(s.inputs) or not all(map(number, c.u))


def _command_stale(s: Settings, w: Situation, c: Command, now: int) -> bool:
    lives = min(c.ttl_ns, s.command_ttl_ns)
    return not (0 <= now - c.t_ns <= lives and 0 <= now - w.asked_ns <= lives)


def _beyond(s: Settings, w: Situation, c: Command, now: int) -> bool:
    if _command_invalid(s, w, c, now):
        return False
    return len(s.input_bounds) != len(c.u) or not all(low <= u <= high for u, (low, high) in zip(c.u, s.input_bounds, strict=True))


BOTH: dict[str, Callable[[Settings, Situation, Command, int], bool]] = {
    "stopping": lambda s, w, c, now: w.stopping,
    "emergency_stop": lambda s, w, c, now: "emergency_stop" in w.latched,
    "manual_override": lambda s, w, c, now: "manual_override" in w.latched,
    "robot_twin": lambda s, w, c, now: "robot_twin" in w.latched,
    "observation_faults": lambda s, w, c, now: "observation_faults" in w.latched,
    "clock_backwards": lambda s, w, c, now: now < w.clock_ns,
    "recorder_down": lambda s, w, c, now: not w.recorder_ok,
    "link_down": lambda s, w, c, now: not w.link_up,
    "observation_invalid": lambda s, w, c, now: w.trouble == "observation_invalid" or (not w.trouble and _unusable(w.observation, s)),
    "observation_out_of_order": lambda s, w, c, now: w.trouble == "observation_out_of_order",
    "observation_missing": lambda s, w, c, now: w.observation is None,
    "observation_stale": lambda s, w, c, now: not 0 <= now - w.observation_ns <= s.observation_timeout_ns,
    "command_invalid": _command_invalid,
    "command_out_of_order": lambda s, w, c, now: w.asked_seq is None or c.obs_seq != w.asked_seq or c.seq <= w.last_command_seq,
    "command_stale": _command_stale,
    "input_out_of_bounds": _beyond,
}
SAMPLER = {
    "latched": lambda s, w, c, now: any(one in holds for one in w.latched for holds in [holds_all()]),
    "no_permit": lambda s, w, c, now: w.permit_until_ns is None,
    "permit_expired": lambda s, w, c, now: w.permit_until_ns is not None and now >= w.permit_until_ns,
    "campaign_not_running": lambda s, w, c, now: not w.campaign_running,
    "outside_geofence": _outside("geofence"),
}
CONTROLLER = {
    "latched": lambda s, w, c, now: bool(w.latched),
    "verification_running": lambda s, w, c, now: w.controller_digest is None and w.verifying,
    "no_controller": lambda s, w, c, now: w.controller_digest is None,
    "analytics_down": lambda s, w, c, now: not w.analytics_up,
    "watch_alarm": lambda s, w, c, now: w.alarmed,
    "certificate_revoked": lambda s, w, c, now: w.revoked,
    "no_certificate": lambda s, w, c, now: w.certificate is None,
    "certificate_expired": _expired,
    "digest_mismatch": _mismatch,
    "radius_above_verified": _outgrown,
    "measurement_faults": lambda s, w, c, now: w.faults > s.max_measurement_faults,
    "outside_region": _outside("region"),
    "settling": lambda s, w, c, now: w.clear_since_ns is None or now - w.clear_since_ns < s.hysteresis_ns,
}
BESIDE_DRIVING = "radius_above_verified"
"""The document: a verification beside driving is looked at after this one."""
_TABLE, _HOLDS_ALL = table(), holds_all()


def reason(settings: Settings, situation: Situation, command: Command, now: int) -> str:
    """The reason that the verdict must give, or `allowed`."""
    if command.source not in ("controller", "sampler"):
        return "source_not_allowed"
    own = CONTROLLER if command.source == "controller" else SAMPLER
    for name in _TABLE:
        if name == "latched":
            held = [one for one in situation.latched if command.source == "controller" or one in _HOLDS_ALL]
            if held:
                return f"latched:{held[0]}"
            continue
        rule = BOTH.get(name) or own.get(name)
        if rule is not None and rule(settings, situation, command, now):
            return name
        if name == BESIDE_DRIVING and command.source == "controller" and situation.verifying:
            return "verification_running"
    return "allowed"


# ---------------------------------------------------------------- cases

LATCHES = ("emergency_stop", "manual_override", "recorder_down", "link_down", "clock_backwards", "measurement_faults", "outside_geofence")
LATCHES += ("robot_twin", "observation_faults", "controller_fault", "watch_alarm", "command_invalid", "observation_stale")
NOTHING = ("permit_until_ns", "controller_digest", "certificate", "observation", "asked_seq", "clear_since_ns")


def case(rng: random.Random, most: int = 3) -> tuple[Settings, Situation, Command, int, list[str]]:
    """The situation in which everything holds, with up to so many faults in it; what was changed, in words."""
    settings, situation, now = SETTINGS, OPEN, NOW
    command = msgspec.structs.replace(COMMAND, source=rng.choice(["controller", "controller", "sampler"]))
    changed = []
    for _ in range(rng.randint(1, most)):
        what = rng.choice(["situation"] * 5 + ["certificate"] * 3 + ["command"] * 4 + ["observation"] * 2 + ["settings", "now", "latched"])
        if what == "now":
            now += rng.choice([-1, 1, S // 100, S // 20, S // 10, S, 10 * S, -S, 10**18, -(10**18)])
        elif what == "latched":
            situation = msgspec.structs.replace(situation, latched=tuple(rng.sample(LATCHES, rng.randint(1, 3))))
        elif what == "settings":
            name = rng.choice(["region", "geofence", "input_bounds", "task_digest", "profile_digest", "observation_timeout_ns"])
            name = rng.choice([name, "command_ttl_ns", "hysteresis_ns", "max_measurement_faults"])
            value = getattr(settings, name)
            settings = msgspec.structs.replace(settings, **{name: _bounds(rng, value) if isinstance(value, tuple) else spoiled(rng, value)})
        elif what == "command":
            command = spoiled(rng, command)
        elif what == "certificate":
            situation = msgspec.structs.replace(situation, certificate=spoiled(rng, situation.certificate))
        elif what == "observation":
            situation = msgspec.structs.replace(situation, observation=spoiled(rng, situation.observation))
        else:
            situation = _situation(rng, situation)
        changed.append(what)
    return settings, situation, command, now, changed


def _bounds(rng: random.Random, bounds: tuple[tuple[float, float], ...]) -> tuple[tuple[float, float], ...]:
    """One row too few or too many, or a bound moved: a row is always a pair."""
    index = rng.randrange(len(bounds))
    low, high = bounds[index]
    row = rng.choice([(spoiled(rng, low), high), (low, spoiled(rng, high)), (high, low)])
    return rng.choice([bounds[:-1], (*bounds, bounds[0]), (*bounds[:index], row, *bounds[index + 1 :])])


def _situation(rng: random.Random, now: Situation) -> Situation:
    name = rng.choice([one for one in now.__struct_fields__ if one not in ("latched", "observation", "certificate")])
    value: Any = spoiled(rng, getattr(now, name))
    if name == "trouble":
        value = rng.choice(["observation_invalid", "observation_out_of_order"])
    elif rng.random() < 0.2:
        name, value = rng.choice(NOTHING), None
    return msgspec.structs.replace(now, **{name: value})
