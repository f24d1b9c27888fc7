"""What the kits need to try built-in effects and tasks, where their own defaults are not enough."""

from __future__ import annotations

from typing import Any, ClassVar

from s2r_runtime.effects.periodic_disturbance import EFFECT as PERIODIC
from s2r_runtime.tasks.stl_task import StlTask
from s2r_runtime.testing.effect_kit import EffectKit
from s2r_runtime.testing.task_kit import TaskKit


class PeriodicKit(EffectKit):
    """Slow against a step: near a step's rate the mean over one is the difference of nearly equal numbers."""

    effect, parameters = PERIODIC, {"amplitude": 0.3, "frequency": 0.7, "phase": 1.0}


class StlKit(TaskKit):
    """A formula; it has no default."""

    task = StlTask
    models = ("unicycle", "differential_drive")
    parameters: ClassVar[dict[str, Any]] = {
        "metric": "always (abs(x) < 3) and eventually[0,2] (goal - y < 4)",
        "start": {"x": [-1.0, 1.0], "y": [-1.0, 1.0], "theta": [-3.0, 3.0]},
        "scenario": {"goal": [1.0, 2.0]},
        "progress": "y - goal",
    }
