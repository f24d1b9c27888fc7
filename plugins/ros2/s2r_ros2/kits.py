"""How `s2r plugin check ros2` tries the transport: in both layouts, with different kinds of pose and command."""

from __future__ import annotations

from functools import partial

from s2r_ros2.testing import Ros2Rig
from s2r_runtime.testing import TransportKit


class BridgeKit(TransportKit):
    """Odometry and Twist through zenoh-bridge-ros2dds. A Twist has no time to live, an odometry message no count."""

    rig = Ros2Rig
    carries = ()
    numbered = False
    tolerance = 1e-12


class RmwKit(TransportKit):
    """Transforms and TwistStamped through rmw_zenoh."""

    rig = partial(Ros2Rig, "rmw", "tf", "twist_stamped")
    carries = ()
    numbered = False
    tolerance = 1e-12
