"""What `s2r status` says: the core's state, and how the daemon and the robot's link are."""

from __future__ import annotations

import os
import time
from typing import TYPE_CHECKING, Any

import msgspec

from s2r_runtime.core import reducer as core
from s2r_runtime.evidence.statements import runs_line
from s2r_runtime.messages import RunLimits

if TYPE_CHECKING:
    from s2r_runtime.daemon.loop import Daemon


def status(daemon: Daemon) -> dict[str, Any]:
    """Plain data: what the core says (docs/json.md), and beside it the campaign under way, the scenarios driven, the log, the processes."""
    trace, anchor = daemon.actions.last_trace, daemon.logbook.anchor()
    found: dict[str, Any] = core.status(daemon.state)
    sampling, health = daemon.sampler.progress(), daemon.logbook.health()
    memory, observation = daemon.state.memory, daemon.observation
    for limits in ((found["runs"] or {}).get(name) for name in ("all", "under_certificate")):
        if limits is not None:
            limits["statement"] = runs_line(msgspec.convert(limits, RunLimits))
    trouble = daemon.actions.unsaved or daemon.trust.trouble
    return found | {
        "robot": daemon.settings.robot,
        "job": daemon.state.jobs[0].purpose if daemon.state.jobs else None,
        "phase": "inputs" if daemon.excitation.running else None if sampling is None else sampling[0],
        "proposal": None
        if found["proposal"] is None
        else {**found["proposal"], "path": str(daemon.models.file(found["proposal"]["digest"]))},
        "trace": None
        if trace is None
        else {"stretch": trace.stretch, "epoch": trace.epoch, "verdict": trace.verdict, "reason": trace.reason},
        "rejected": {} if sampling is None else sampling[3],
        "revoked": dict(memory.revoked),
        "measured": memory.watch_n,
        "exceedances": memory.watch_exceedances,
        "scenarios": daemon.state.episodes,
        "episodes": [{"index": e.index, "steps": e.steps, "safety": e.safety, "progress": e.progress} for e in daemon.actions.episodes],
        "observation": None if observation is None else {"seq": observation.seq, "x": list(observation.x), "fault": observation.fault},
        "analytics": "up" if daemon.watcher.up else "down",
        "recorder": trouble if health.ok and trouble else "ok" if health.ok else health.detail,
        "log": str(daemon.logbook.paths[-1]),
        "log_head": None if anchor is None else {"run": anchor.run, "part": anchor.part, "records": anchor.records, "head": anchor.head},
        "recorded": health.recorded,
        "link_trouble": daemon.link.trouble,
        "counters": daemon.link.counters(),
        "controller_latency_ms": daemon.driver.latency_ns * 1e-6,
        "controller_contained": list(daemon.driver.contained),
        "uptime_s": (time.monotonic_ns() - daemon.began_ns) * 1e-9,
        "pids": {"daemon": os.getpid(), "analytics": daemon.watcher.pid, "controller": daemon.driver.pid},
    }
