"""A bad `[transport]` table is refused with what would be right."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from s2r_ros2.transport import Ros2Transport

from s2r_runtime.errors import ConfigError

HERE = {"robot_connect": "tcp/127.0.0.1:7447"}


@pytest.mark.parametrize(
    ("options", "why"),
    [
        ({}, "needs robot_listen or robot_connect"),
        ({**HERE, "layuot": "rmw"}, "did you mean 'layout'"),
        ({**HERE, "layout": "dds"}, "must be one of bridge, rmw"),
        ({**HERE, "pose": "odometri"}, "did you mean 'odometry'"),
        ({**HERE, "pose": "tf"}, "needs frame and child_frame"),
        ({**HERE, "pose": 3}, "must be text"),
        ({**HERE, "domain": 233}, "must be in 0 to 232"),
        ({**HERE, "domain": True}, "must be a whole number"),
        ({**HERE, "period": -1.0}, ">= 0 s"),
        ({**HERE, "max_tilt": 4.0}, "> 0 rad"),
        ({**HERE, "observation_timeout": float("inf")}, "must be a number of seconds"),
        ({**HERE, "queue": 0}, ">= 1"),
        ({**HERE, "pose_topic": "odom/"}, "must be a ROS name"),
        ({**HERE, "pose_topic": "a/**"}, "must be a ROS name"),
        ({**HERE, "command_topic": ""}, "is empty"),
        ({**HERE, "command_topic": "/odom"}, "must differ"),
        ({**HERE, "emergency_stop": "cmd_vel"}, "must differ"),
        ({**HERE, "node": "a-b"}, "must be a ROS node's name"),
        ({**HERE, "controller_listen": HERE["robot_connect"]}, "share tcp/127.0.0.1:7447"),
        ({**HERE, "controller_listen": "7448"}, "must be an endpoint"),
        ({**HERE, "inputs": {"v": "linear"}}, "must be one of linear.x"),
        ({**HERE, "inputs": {"v": "angular.z"}}, "fields that differ"),
        ({**HERE, "inputs": {"u": "linear.x"}}, "is not an input"),
        ({**HERE, "inputs": "v"}, "must be a table"),
        ({**HERE, "states": {"q": "x"}}, "is not a state"),
        ({**HERE, "states": {"x": "north"}}, "must be one of x, y"),
    ],
)
def test_bad_option_is_refused(options: dict[str, Any], why: str) -> None:
    with pytest.raises(ConfigError, match=why):
        Ros2Transport(options, ("x", "y", "theta"), ("v", "w"))


def test_model_that_the_robot_cannot_serve_is_refused() -> None:
    with pytest.raises(ConfigError, match="the model also has wheel_left"):
        Ros2Transport(HERE, ("x", "y", "theta", "wheel_left"), ("v", "w"))
    with pytest.raises(ConfigError, match="pose = pose_stamped tells x, y, theta; the model also has speed"):
        Ros2Transport({**HERE, "pose": "pose_stamped"}, ("x", "y", "theta", "speed"), ("v", "w"))
    with pytest.raises(ConfigError, match="which field of a Twist cmd_left"):
        Ros2Transport(HERE, ("x", "y", "theta"), ("cmd_left", "w"))


def test_files_that_cannot_be_used_are_named() -> None:
    transport = Ros2Transport({**HERE, "robot_config": "/nowhere.json5"}, ("x", "y", "theta"), ("v", "w"))
    with pytest.raises(ConfigError, match=r"nowhere\.json5"):
        transport.open()


def test_page_explains_every_option_and_every_counter() -> None:
    page = (Path(__file__).parents[3] / "docs" / "ros2.md").read_text(encoding="utf-8")
    transport = Ros2Transport(HERE, ("x", "y", "theta"), ("v", "w"))
    assert [name for name in (*transport.OPTIONS, *transport.counters()) if f"`{name}`" not in page] == []
