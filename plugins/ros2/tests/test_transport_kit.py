"""The ROS 2 transport is what the runtime relies on, in both layouts."""

from __future__ import annotations

from s2r_ros2.kits import BridgeKit, RmwKit


class TestBridge(BridgeKit):
    pass


class TestRmw(RmwKit):
    pass
