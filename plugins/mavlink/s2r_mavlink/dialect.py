"""The messages of MAVLink's `common` dialect that this software speaks, as tables: number, fields in wire order, formats.

Wire order is by size of the fields (8, 4, 2, 1 bytes), little-endian; extension fields follow as they were declared. A sender of
version 2 leaves trailing zero bytes out, a receiver puts them back. CRC_EXTRA is a checksum over a message's definition that goes into the
checksum of every frame: sender and receiver that mean different things by one number do not understand one another. Both tables are
facts of the protocol (message definitions `common.xml`, mavlink.io) and are compared with pymavlink's by the tests.
"""

from __future__ import annotations

import struct
from typing import Any, NamedTuple

HEARTBEAT = 0
ATTITUDE = 30
LOCAL_POSITION_NED = 32
GLOBAL_POSITION_INT = 33
SERVO_OUTPUT_RAW = 36
MANUAL_CONTROL = 69
RC_CHANNELS_OVERRIDE = 70
COMMAND_INT = 75
COMMAND_LONG = 76
COMMAND_ACK = 77
SET_POSITION_TARGET_LOCAL_NED = 84
SET_POSITION_TARGET_GLOBAL_INT = 86
HIL_ACTUATOR_CONTROLS = 93
VISION_POSITION_ESTIMATE = 102
TIMESYNC = 111
MESSAGE_INTERVAL = 244
STATUSTEXT = 253
ODOMETRY = 331
ACTUATOR_OUTPUT_STATUS = 375

DO_SET_MODE = 176
COMPONENT_ARM_DISARM = 400
GET_MESSAGE_INTERVAL = 510
SET_MESSAGE_INTERVAL = 511

ACCEPTED, TEMPORARILY_REJECTED, DENIED, UNSUPPORTED, FAILED, IN_PROGRESS = range(6)
"""Results of a COMMAND_ACK."""
RESULTS = ("accepted", "temporarily rejected", "denied", "unsupported", "failed", "in progress")

BODY_FRAMES = (8, 9, 12)
"""MAV_FRAME BODY_NED, BODY_OFFSET_NED, BODY_FRD: forward, right, down."""


def result(number: int) -> str:
    """A result in words."""
    return RESULTS[number] if number < len(RESULTS) else f"result {number}"


class Message(NamedTuple):
    """One kind of message."""

    number: int
    name: str
    layout: struct.Struct
    fields: tuple[str, ...]

    def pack(self, *values: Any) -> bytes:
        """The payload, trailing zeros left out (one byte stays)."""
        return self.layout.pack(*values).rstrip(b"\0") or b"\0"

    def unpack(self, payload: bytes) -> tuple[Any, ...]:
        """Values in wire order, arrays flat. Missing bytes are zero; bytes beyond what is known here are ignored."""
        size = self.layout.size
        if len(payload) == size:
            return self.layout.unpack(payload)
        return self.layout.unpack_from(payload.ljust(size, b"\0"))


def _message(number: int, name: str, layout: str, fields: str) -> Message:
    return Message(number, name, struct.Struct("<" + layout), tuple(fields.split()))


def _numbered(name: str, first: int, last: int) -> str:
    return " ".join(name.format(k) for k in range(first, last + 1))


_TARGET = "target_system target_component"

MESSAGES: dict[int, Message] = {
    m.number: m
    for m in (
        _message(HEARTBEAT, "HEARTBEAT", "IBBBBB", "custom_mode type autopilot base_mode system_status mavlink_version"),
        _message(ATTITUDE, "ATTITUDE", "I6f", "time_boot_ms roll pitch yaw rollspeed pitchspeed yawspeed"),
        _message(LOCAL_POSITION_NED, "LOCAL_POSITION_NED", "I6f", "time_boot_ms x y z vx vy vz"),
        _message(GLOBAL_POSITION_INT, "GLOBAL_POSITION_INT", "I4i3hH", "time_boot_ms lat lon alt relative_alt vx vy vz hdg"),
        _message(COMMAND_INT, "COMMAND_INT", "4f2ifH5B", f"param1 param2 param3 param4 x y z command {_TARGET} frame current autocontinue"),
        _message(COMMAND_LONG, "COMMAND_LONG", "7fH3B", f"param1 param2 param3 param4 param5 param6 param7 command {_TARGET} confirmation"),
        _message(COMMAND_ACK, "COMMAND_ACK", "HBBiBB", f"command result progress result_param2 {_TARGET}"),
        _message(
            SET_POSITION_TARGET_LOCAL_NED,
            "SET_POSITION_TARGET_LOCAL_NED",
            "I11fH3B",
            f"time_boot_ms x y z vx vy vz afx afy afz yaw yaw_rate type_mask {_TARGET} coordinate_frame",
        ),
        _message(VISION_POSITION_ESTIMATE, "VISION_POSITION_ESTIMATE", "Q6f21fB", "usec x y z roll pitch yaw covariance reset_counter"),
        _message(TIMESYNC, "TIMESYNC", "qqBB", f"tc1 ts1 {_TARGET}"),
        _message(MESSAGE_INTERVAL, "MESSAGE_INTERVAL", "iH", "interval_us message_id"),
        _message(STATUSTEXT, "STATUSTEXT", "B50sHB", "severity text id chunk_seq"),
        _message(
            ODOMETRY,
            "ODOMETRY",
            "Q3f4f6f21f21f4Bb",
            "time_usec x y z q vx vy vz rollspeed pitchspeed yawspeed pose_covariance velocity_covariance "
            "frame_id child_frame_id reset_counter estimator_type quality",
        ),
    )
}

LOGGED: dict[int, Message] = {
    m.number: m
    for m in (
        _message(
            SERVO_OUTPUT_RAW,
            "SERVO_OUTPUT_RAW",
            "I8HB8H",
            f"time_usec {_numbered('servo{}_raw', 1, 8)} port {_numbered('servo{}_raw', 9, 16)}",
        ),
        _message(MANUAL_CONTROL, "MANUAL_CONTROL", "4hHB", "x y z r buttons target"),
        _message(
            RC_CHANNELS_OVERRIDE,
            "RC_CHANNELS_OVERRIDE",
            "8H2B10H",
            f"{_numbered('chan{}_raw', 1, 8)} {_TARGET} {_numbered('chan{}_raw', 9, 18)}",
        ),
        _message(
            SET_POSITION_TARGET_GLOBAL_INT,
            "SET_POSITION_TARGET_GLOBAL_INT",
            "I2i9fH3B",
            f"time_boot_ms lat_int lon_int alt vx vy vz afx afy afz yaw yaw_rate type_mask {_TARGET} coordinate_frame",
        ),
        _message(HIL_ACTUATOR_CONTROLS, "HIL_ACTUATOR_CONTROLS", "QQ16fB", "time_usec flags controls mode"),
        _message(ACTUATOR_OUTPUT_STATUS, "ACTUATOR_OUTPUT_STATUS", "QI32f", "time_usec active actuator"),
    )
}
"""Messages that only logs are read for: what somebody commanded by other means, and what the actuators got."""

# fmt: off
CRC_EXTRA: dict[int, int] = {
    0: 50, 1: 124, 2: 137, 4: 237, 5: 217, 6: 104, 7: 119, 11: 89, 20: 214, 21: 159, 22: 220, 23: 168, 24: 24, 25: 23, 26: 170, 27: 144,
    28: 67, 29: 115, 30: 39, 31: 246, 32: 185, 33: 104, 34: 237, 35: 244, 36: 222, 37: 212, 38: 9, 39: 254, 40: 230, 41: 28, 42: 28,
    43: 132, 44: 221, 45: 232, 46: 11, 47: 153, 48: 41, 49: 39, 50: 78, 51: 196, 54: 15, 55: 3, 61: 167, 62: 183, 63: 119, 64: 191,
    65: 118, 66: 148, 67: 21, 69: 243, 70: 124, 73: 38, 74: 20, 75: 158, 76: 152, 77: 143, 81: 106, 82: 49, 83: 22, 84: 143, 85: 140,
    86: 5, 87: 150, 89: 231, 90: 183, 91: 63, 92: 54, 93: 47, 100: 175, 101: 102, 102: 158, 103: 208, 104: 56, 105: 93, 106: 138,
    107: 108, 108: 32, 109: 185, 110: 84, 111: 34, 112: 174, 113: 124, 114: 237, 115: 4, 116: 76, 117: 128, 118: 56, 119: 116, 120: 134,
    121: 237, 122: 203, 123: 250, 124: 87, 125: 203, 126: 220, 127: 25, 128: 226, 129: 46, 130: 29, 131: 223, 132: 85, 133: 6, 134: 229,
    135: 203, 136: 1, 137: 195, 138: 109, 139: 168, 140: 181, 141: 47, 142: 72, 143: 131, 144: 127, 146: 103, 147: 154, 148: 178,
    149: 200, 162: 189, 192: 36, 225: 208, 230: 163, 231: 105, 232: 151, 233: 35, 234: 150, 235: 179, 241: 90, 242: 104, 243: 85, 244: 95,
    245: 130, 246: 184, 247: 81, 248: 8, 249: 204, 250: 49, 251: 170, 252: 44, 253: 83, 254: 46, 256: 71, 257: 131, 258: 187, 259: 92,
    260: 146, 261: 179, 262: 12, 263: 133, 264: 49, 265: 26, 266: 193, 267: 35, 268: 14, 269: 109, 270: 59, 271: 22, 275: 126, 276: 18,
    277: 62, 280: 70, 281: 48, 282: 123, 283: 74, 284: 99, 285: 137, 286: 210, 287: 1, 288: 20, 295: 234, 296: 158, 299: 19, 301: 243,
    310: 28, 311: 95, 320: 243, 321: 88, 322: 243, 323: 78, 324: 132, 330: 23, 331: 91, 332: 236, 333: 231, 335: 225, 339: 199, 340: 99,
    345: 209, 350: 232, 360: 11, 370: 75, 373: 117, 375: 251, 376: 199, 385: 147, 386: 132, 387: 4, 388: 8, 390: 156, 9000: 113,
    9005: 117, 12900: 114, 12901: 254, 12902: 140, 12903: 249, 12904: 77, 12905: 49, 12915: 94, 12918: 139, 12919: 7, 12920: 20,
}
# fmt: on
"""Of every message of the dialect, so that a frame whose content nobody here reads can be told from noise."""
