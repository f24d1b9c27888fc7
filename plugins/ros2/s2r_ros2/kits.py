"""How `s2r plugin check ros2` tries the transport: in both layouts, with a robot's node on loopback."""

from __future__ import annotations

from functools import partial

from s2r_ros2.testing import Ros2Rig
from s2r_runtime.testing import TransportKit


class BridgeKit(TransportKit):
    """Odometry and Twist, in the keys of zenoh-bridge-ros2dds. A Twist carries nothing but itself; the heading is a quaternion's."""

    rig = Ros2Rig
    carries = ()
    numbered = False
    tolerance = 1e-12


class RmwKit(TransportKit):
    """TF and TwistStamped, in the keys of rmw_zenoh."""

    rig = partial(Ros2Rig, "rmw", "tf", "twist_stamped")
    carries = ()
    numbered = False
    tolerance = 1e-12
