"""What each reason of the gate means, in plain words, for the console and the command line (docs/gate.md has the whole table)."""

from __future__ import annotations

WORDS: dict[str, str] = {
    "allowed": "the controller's commands pass",
    "source_not_allowed": "an unknown source commanded",
    "not_started": "the run has not begun",
    "memory_refused": "the saved state is of another robot or version",
    "stopping": "the daemon is ending",
    "emergency_stop": "emergency stop",
    "manual_override": "a person drives by other means",
    "robot_twin": "two robots answer under one name",
    "observation_faults": "too many observations are faulty",
    "clock_backwards": "the clock ran backward",
    "recorder_down": "nothing can be recorded",
    "link_down": "the robot is not heard",
    "latched": "an earlier reason is not cleared yet",
    "no_permit": "nobody gave the sampler a permit",
    "permit_expired": "the sampler's permit is over",
    "campaign_not_running": "no campaign runs",
    "controller_fault": "the controller failed",
    "verification_running": "the controller is being verified",
    "no_controller": "no controller is deployed",
    "analytics_down": "the process that measures the gap is down",
    "watch_alarm": "the watch refuted the gap",
    "certificate_revoked": "the certificate was revoked",
    "no_certificate": "the controller has no certificate",
    "certificate_expired": "the certificate has expired",
    "digest_mismatch": "what runs is not what was certified",
    "radius_above_verified": "the gap outgrew what was verified",
    "measurement_faults": "too many measurements are faulty",
    "observation_invalid": "the newest observation is not usable",
    "observation_out_of_order": "an observation is older than the one before",
    "observation_missing": "the robot was not observed yet",
    "observation_stale": "the newest observation is too old",
    "outside_region": "the robot is outside the certified region",
    "outside_geofence": "the robot is outside the geofence",
    "command_invalid": "the command is not a usable number",
    "command_out_of_order": "the command answers no open question",
    "command_stale": "the command is too old",
    "input_out_of_bounds": "an input is out of its bounds",
    "settling": "all conditions hold, and the hysteresis is not over",
}


def in_words(reason: str) -> str:
    """The reason with its meaning: "no controller is deployed (no_controller)"; a latched one with the command that clears it."""
    bare = reason.removeprefix("latched:")
    words = WORDS.get(bare)
    named = f"{words} ({bare})" if words else bare
    return f"{named}, until: s2r clear {bare}" if bare != reason else named
