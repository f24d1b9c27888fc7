"""The profile's [transport] table: one clear line for every mistake, and nothing opened before `open`."""

from __future__ import annotations

import socket
from pathlib import Path
from typing import Any

import pytest
from s2r_mavlink.options import DEFAULTS, MEANINGS
from s2r_mavlink.testing import INPUTS, STATES, free_port
from s2r_mavlink.transport import MavlinkTransport

from s2r_runtime.errors import ConfigError
from s2r_runtime.profile import check_names, load_profile

ROOT = Path(__file__).parents[3]
UDP = {"robot": "udp:127.0.0.1:14551"}


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({}, "needs robot, such as udp:127.0.0.1:14551"),
        ({"robot": "127.0.0.1:14551"}, "robot is '127.0.0.1:14551', must be udp:HOST:PORT"),
        ({"robot": "udp:127.0.0.1:0"}, "must be a port in 1 to 65535"),
        ({"robot": "serial:/dev/ttyACM0:123"}, "must be a baud rate that this system knows"),
        ({"robot": "tcpin:127.0.0.1:5760"}, "a robot is connected to"),
        ({"robot": 14551}, "robot is 14551, must be text"),
        ({**UDP, "rat": 50.0}, "rat is not an option of the mavlink transport; did you mean 'rate'"),
        ({**UDP, "ground": UDP["robot"]}, "share an endpoint"),
        ({**UDP, "system": 0}, "system is 0, must be in 1 to 255"),
        ({**UDP, "system": True}, "system is True, must be a whole number"),
        ({**UDP, "own_component": 1}, "must not be one of the robot's"),
        ({**UDP, "rate": 0.0}, "rate is 0.0, must be > 0 Hz"),
        ({**UDP, "max_age": -1.0}, "max_age is -1.0, must be > 0 s"),
        ({**UDP, "observation_timeout": float("inf")}, "must be > 0 s"),
        ({**UDP, "queue": 1}, "queue is 1, must be >= 2"),
        ({**UDP, "take_over": "always"}, "take_over is 'always', must be one of never, mode, arm"),
        ({**UDP, "pose": "locl"}, "did you mean 'local'"),
        ({**UDP, "mode": "GIUDED"}, "mode is 'GIUDED', must be a mode of ArduPilot Rover"),
        ({**UDP, "mode": "", "take_over": "arm"}, "mode is empty, must be a mode where take_over"),
        ({**UDP, "stop_mode": "guided"}, "must be another mode than transport.mode"),
        ({**UDP, "stop_when": "closed"}, "must come with transport.stop_mode, such as HOLD"),
        ({**UDP, "origin": [48.0, 11.0]}, "only with pose = gps"),
        ({**UDP, "pose": "gps"}, "origin is [], must be [latitude, longitude]"),
        ({**UDP, "pose": "gps", "origin": [91.0, 0.0]}, "must be [latitude, longitude]"),
    ],
)
def test_bad_option_is_refused_with_what_would_be_right(options: dict[str, Any], says: str) -> None:
    with pytest.raises(ConfigError) as refusal:
        MavlinkTransport(options, STATES, INPUTS)
    assert says in str(refusal.value)
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize(
    ("options", "states", "inputs", "says"),
    [
        ({}, ("x", "y", "theta", "wheel_left"), INPUTS, "the model also has wheel_left"),
        ({}, STATES, ("force",), "takes the inputs v, w; the model also has force"),
        ({"pose": "vision"}, ("x", "y", "theta", "speed"), INPUTS, "pose = vision tells x, y, theta; the model also has speed"),
    ],
)
def test_model_that_asks_for_what_mavlink_does_not_carry_is_refused(
    options: dict[str, Any], states: tuple[str, ...], inputs: tuple[str, ...], says: str
) -> None:
    with pytest.raises(ConfigError, match=says):
        MavlinkTransport({**UDP, **options}, states, inputs)


def test_every_option_has_a_default_and_a_meaning() -> None:
    assert set(DEFAULTS) == set(MEANINGS)
    page = (ROOT / "docs" / "mavlink.md").read_text(encoding="utf-8")
    assert [name for name in DEFAULTS if f"`{name}`" not in page] == []


def test_every_counter_is_explained() -> None:
    page = (ROOT / "docs" / "mavlink.md").read_text(encoding="utf-8")
    transport = MavlinkTransport({**UDP, "ground": "tcpin:127.0.0.1:5770"}, STATES, INPUTS)
    names = {name.replace("ground_", "").partition("interval_us_")[0] or "interval_us_" for name in transport.counters()}
    assert [name for name in names if f"`{name}" not in page] == []


def test_profile_of_the_rover_is_valid() -> None:
    path = ROOT / "profiles" / "rover-mavlink.toml"
    check_names(load_profile(path), str(path))


def test_address_that_is_taken_or_unknown_is_one_clear_line() -> None:
    port = free_port()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(("127.0.0.1", port))
        with pytest.raises(ConfigError, match=f"udp:127.0.0.1:{port}: Address already in use"):
            MavlinkTransport({"robot": f"udp:127.0.0.1:{port}"}, STATES, INPUTS).open()
    with pytest.raises(ConfigError, match="is not known"):
        MavlinkTransport({"robot": "tcp:no.such.host.invalid:5760"}, STATES, INPUTS).open()
    with pytest.raises(ConfigError, match="serial:/etc/passwd:57600"):
        MavlinkTransport({"robot": "serial:/etc/passwd:57600"}, STATES, INPUTS).open()


def test_key_that_cannot_be_read_is_one_clear_line(tmp_path: Path) -> None:
    transport = MavlinkTransport({**UDP, "signing_key_file": str(tmp_path / "none")}, STATES, INPUTS)
    with pytest.raises(ConfigError, match=r"signing_key_file: .* cannot be read"):
        transport.open()
    assert transport.fileno() == -1
