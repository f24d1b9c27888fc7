"""Conformance kits for authors of plug-ins: what the runtime relies on, as tests that a class inherits.

    from s2r_runtime.testing import TransportKit

    class TestMyBus(TransportKit):
        rig = MyBusRig                # a transport and a robot's end of it: see `transport_kit.Rig`

    from s2r_runtime.testing import EffectKit, ModelKit, TaskKit

    class TestBacklash(EffectKit):
        effect, parameters = BACKLASH, {"width": 0.02}

    class TestMyRobot(ModelKit):
        model = MODEL

    class TestMyTask(TaskKit):
        task = MyTask

Offered by the hook `s2r_kits`, `s2r plugin check` runs them wherever the plug-in is installed. Needs pytest; nothing of the runtime
imports this.
"""

from __future__ import annotations

import pytest

pytest.register_assert_rewrite(*(f"s2r_runtime.testing.{kit}_kit" for kit in ("transport", "effect", "model", "task")))

from s2r_runtime.testing.effect_kit import EffectKit  # noqa: E402 - what is registered above must be imported after it
from s2r_runtime.testing.model_kit import ModelKit  # noqa: E402
from s2r_runtime.testing.task_kit import TaskKit  # noqa: E402
from s2r_runtime.testing.transport_kit import Rig, RobotEnd, TransportKit  # noqa: E402

__all__ = ["EffectKit", "ModelKit", "Rig", "RobotEnd", "TaskKit", "TransportKit"]
