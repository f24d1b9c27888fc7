"""The verbs of the command line: what each does, in a line, and the module that knows it. `s2r --help` needs no more than this."""

from __future__ import annotations

from typing import NamedTuple


class Verb(NamedTuple):
    """module: of this package, with `add(verbs)`. summary: without a full stop."""

    module: str
    summary: str


GROUPS: dict[str, dict[str, Verb]] = {
    "see it work": {
        "demo": Verb(
            "demo", "the whole loop on a built-in robot: sample, gap, verify, refuse, trace, repair, certify, drive, revoke, audit"
        ),
    },
    "drive a robot": {
        "run": Verb("daemon_verbs", "the daemon: talks to the robot, guards it, records everything"),
        "permit": Verb("daemon_verbs", "let the sampler drive inside the geofence for a limited time"),
        "sample": Verb("daemon_verbs", "one sampling campaign, through the running daemon if there is one"),
        "deploy": Verb("daemon_verbs", "let this controller drive, if a certificate covers it; verify it first if none does"),
        "undeploy": Verb("daemon_verbs", "end the deployment; the recovery controller stops the robot"),
        "status": Verb("daemon_verbs", "what the daemon is doing, and why"),
        "stop": Verb("daemon_verbs", "emergency stop; latches until cleared"),
        "clear": Verb("daemon_verbs", "clear a latched reason, after looking into it"),
        "revoke": Verb("daemon_verbs", "withdraw a certificate, or all of them"),
        "adopt": Verb("daemon_verbs", "use this model from now on; voids the gap, so a fresh campaign comes next"),
    },
    "compute from recordings": {
        "topics": Verb("topics_verb", "what a recording holds: topics, rates, spans, and signals for --state and --input"),
        "gap": Verb("evidence", "the sim2real gap that a recording shows, and its statement"),
        "trace": Verb("trace_verb", "find the effect that the model lacks, add it, and report the error before and after"),
        "verify": Verb("evidence", "run a controller on the uncertain model and say what that shows"),
        "synthesize": Verb(
            "synthesize_verb", "search a controller's parameters, then verify the winner on scenarios that did not choose it"
        ),
        "certify": Verb("certify", "gap + verify + sign: a certificate for this controller from a recorded campaign"),
        "trials": Verb("trials_verb", "closed-loop runs of a controller on the robot, from its logs, and what they show"),
        "compare": Verb("compare_verb", "whether controller B is worse than controller A on the robot, from paired runs"),
    },
    "look at a log": {
        "live": Verb("live_verb", "what a robot does, as it does it, or a log once more: for Foxglove and Lichtblick"),
        "audit": Verb("log_verbs", "recompute every number and every decision from the log alone"),
        "report": Verb("log_verbs", "plots and statements of a log on one self-contained page"),
        "export": Verb("live_verb", "a log's quantities under their names, for Foxglove, Lichtblick and PlotJuggler"),
        "log": Verb("log_verbs", "look at a log, or recover what a crash left"),
    },
    "set up": {
        "doctor": Verb("setup_verbs", "what is missing on this machine, and what to do about it"),
        "profile": Verb("setup_verbs", "check a robot's profile"),
        "keys": Verb("keys_verb", "signing keys"),
        "plugin": Verb("plugin_verb", "what is installed; check it, or begin a new one"),
    },
}
"""In the order of `s2r --help`."""
VERBS = {name: verb for verbs in GROUPS.values() for name, verb in verbs.items()}
