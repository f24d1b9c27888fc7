"""What this package offers."""

from __future__ import annotations

from s2r_runtime.hookspecs import Offer, hookimpl


@hookimpl
def s2r_transports() -> list[Offer]:
    """The ROS 2 transport."""
    return [Offer("ros2", "s2r_ros2.transport:Ros2Transport", "ROS 2 robots over Zenoh (bridge or rmw_zenoh), without ROS")]


@hookimpl
def s2r_recordings() -> list[Offer]:
    """Bags."""
    return [Offer("ros2.bag", "s2r_ros2.bags:read", "bags of ROS 2 (MCAP, SQLite, folders) and ROS 1")]


@hookimpl
def s2r_formats() -> list[Offer]:
    """Bags as named time series."""
    return [Offer("bag", "s2r_ros2.series:open_series", "bags of ROS 2 and ROS 1: topics of any type, by rosbags")]


@hookimpl
def s2r_kits() -> list[Offer]:
    """How the transport is tried."""
    return [Offer("transports.ros2", "s2r_ros2.kits:BridgeKit"), Offer("transports.ros2.rmw", "s2r_ros2.kits:RmwKit")]
