"""The ROS 2 transport is what the runtime relies on, in both layouts and with every kind of pose."""

from __future__ import annotations

from functools import partial

from s2r_ros2.testing import Ros2Rig

from s2r_runtime.testing import TransportKit


class TestBridge(TransportKit):
    rig = Ros2Rig
    carries = ()
    numbered = False
    tolerance = 1e-12


class TestRmw(TestBridge):
    rig = partial(Ros2Rig, "rmw", "tf", "twist_stamped")
