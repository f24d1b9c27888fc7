"""Conformance kits for authors of plug-ins: what the runtime relies on, as tests that a class inherits.

    from s2r_runtime.testing import TransportKit

    class TestMyBus(TransportKit):
        rig = MyBusRig                # a transport and a robot's end of it: see `transport_kit.Rig`

    from s2r_runtime.testing import EffectKit

    class TestBacklash(EffectKit):
        effect, parameters = BACKLASH, {"width": 0.02}

Needs pytest; nothing of the runtime imports this.
"""

from __future__ import annotations

import pytest

pytest.register_assert_rewrite("s2r_runtime.testing.transport_kit", "s2r_runtime.testing.effect_kit")

from s2r_runtime.testing.effect_kit import EffectKit  # noqa: E402 - what is registered above must be imported after it
from s2r_runtime.testing.transport_kit import Rig, RobotEnd, TransportKit  # noqa: E402

__all__ = ["EffectKit", "Rig", "RobotEnd", "TransportKit"]
