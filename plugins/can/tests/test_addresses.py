"""J1939: messages by their parameter group, from any source address or a stated one."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import can
import pytest
from s2r_can.recordings import read
from s2r_can.records import EXTENDED, Record, packed
from s2r_can.transport import CanTransport

from s2r_runtime.errors import ConfigError
from s2r_runtime.messages import Command, Frame, Observation

STATE, CMD = 0x18FF10FE, 0x18FF20FE
DBC = f"""VERSION ""
BO_ {STATE | EXTENDED} State: 8 A
 SG_ Pos : 0|32@1- (0.0001,0) [-1000|1000] "m" B
 SG_ Vel : 32|32@1- (0.0001,0) [-1000|1000] "m/s" B
BO_ {CMD | EXTENDED} Cmd: 8 B
 SG_ Force : 0|16@1- (0.001,0) [-30|30] "N" A
"""


def options(**sources: Any) -> dict[str, Any]:
    return {
        "dbc": {"file": "j.dbc", "text": DBC},
        "trigger": "State",
        "robot": {"interface": "virtual", "channel": "a"},
        "states": {"q": "State.Pos", "qd": "State.Vel"},
        "inputs": {"force": "Cmd.Force"},
        "source_addresses": sources,
    }


def heard(identifiers: list[int], **sources: Any) -> list[Any]:
    transport = CanTransport(options(**sources), ("q", "qd"), ("force",))
    data = b"".join(
        packed(Record(10_000_000 * (k + 1), i | EXTENDED, 0, bytes([k, 0, 0, 0, 0, 0, 0, 0]))) for k, i in enumerate(identifiers)
    )
    return [one for one in transport.decode(Frame(0, "robot", data)) if isinstance(one, Observation)]


@pytest.mark.parametrize(
    ("sources", "identifiers", "good"),
    [
        ({}, [STATE, 0x18FF1021], 1),
        ({"State": "any"}, [0x18FF1021, 0x18FF1021, 0x0CFF1021], 3),
        ({"State": 0x21}, [0x18FF1021, 0x0CFF1021, STATE, 0x18FF1022], 2),
        ({"State": 0x21}, [0x18FF1121, 0x18FE1021], 0),
    ],
)
def test_source_address_is_the_dbcs_any_or_a_stated_one_and_the_priority_does_not_count(
    sources: dict[str, Any], identifiers: list[int], good: int
) -> None:
    assert sum(not one.fault for one in heard(identifiers, **sources)) == good


def test_two_nodes_that_send_what_any_may_send_are_a_fault() -> None:
    faults = [one.fault for one in heard([0x18FF1021, 0x18FF1022, 0x18FF1021], State="any") if one.fault]
    assert faults == ["18FF10FE is sent from the addresses 33 and 34: state one in transport.source_addresses"]


def test_commands_leave_with_the_stated_address() -> None:
    transport = CanTransport(options(Cmd=0x80), ("q", "qd"), ("force",))
    data = transport.encode(Command(1, 0, "sampler", (0.0,), 0, 1)).data
    assert int.from_bytes(data[8:12], "little") == 0x18FF2080 | EXTENDED
    for sources, wrong in (({"Cmd": "any"}, "it is sent by the runtime"), ({"State": 254}, "0 to 253"), ({"Stat": 1}, "no message 'Stat'")):
        with pytest.raises(ConfigError, match=wrong):
            CanTransport(options(**sources), ("q", "qd"), ("force",))


def test_recording_has_the_messages_of_any_address(tmp_path: Path) -> None:
    path = tmp_path / "a.log"
    with can.CanutilsLogWriter(path) as log:
        for k in range(100):
            for identifier, later in ((0x18FF1021, 0.0), (0x18FF2080, 0.001)):
                data = bytes([k, 0, 0, 0, k, 0, 0, 0])
                log.on_message_received(can.Message(timestamp=1.7e9 + 0.02 * k + later, arbitration_id=identifier, data=data))
    (((t, x), (_, u)),) = read(path, ("q", "qd"), ("force",), options(State="any", Cmd=0x80)).stretches
    assert len(t) == len(u) == 100
    assert x[:, 0] == pytest.approx([1e-4 * k for k in range(100)])
