"""A trace that found an effect, and what it proposes."""

from __future__ import annotations

from typing import Any

from core_rig import Rig, of

from s2r_runtime.messages import (
    JobFinished,
    Output,
    Proposal,
    StartJob,
)

FOUND: dict[str, Any] = {"verdict": "traced", "proposal": {"digest": "better", "proposed": True, "effects": ["input_gain on w"]}}

PROPOSED = Proposal("better", "model", "campaign", 1, ("input_gain on w",))


def traced(rig: Rig, trace: dict[str, Any] | None = None, error: str = "") -> list[Output]:
    """The running trace ends."""
    order = [job for job in of(rig.outputs, StartJob) if job.kind == "trace"][-1]
    return rig.feed(JobFinished(rig.t, order.job_id, "trace", trace=None if error else trace or FOUND, error=error))
