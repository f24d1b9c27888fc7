"""Feeds the ROS 2 transport's decoder with frames that nobody should send, and holds every observation against what the bytes say.

    python tools/fuzz_ros2.py [--inputs N] [--seed S] [--quick] [--json]

What the bytes say is told by others: the payload by a reader of its own that goes through the interface's fields one by one, the pose by
the rotation matrix of its quaternion. A *lie* is an observation that is not of a whole message of the right type in the right frames,
with a sane quaternion on the plane, exactly as it says; or one whose stamp did not rise. A crash is an exception.
"""

from __future__ import annotations

import argparse
import json
import math
import random
import struct
import sys
import time
from typing import Any, NamedTuple

from s2r_ros2.interfaces import FIELDS, ODOMETRY, POSE_STAMPED, TF, element
from s2r_ros2.keys import attachment, envelope
from s2r_ros2.payloads import Located, encode_bool, encode_odometry, encode_pose_stamped, encode_transforms, encode_twist
from s2r_ros2.transport import Ros2Transport

from s2r_runtime.messages import Command, Frame, Observation

STATES, INPUTS = ("x", "y", "theta", "speed", "w"), ("v", "w")
KINDS = {"odometry": ODOMETRY, "pose_stamped": POSE_STAMPED, "tf": TF}
FRAME, CHILD = "odom", "base_footprint"
TILT = 0.2
ANEW = 500
"""Inputs to one decoder: one that has believed a stamp from the future waits for it, and tries little until then."""
SPECIAL = (math.nan, math.inf, -math.inf, 1e300, -1e300, 5e-324, 1e7, -0.0)
PERIOD_NS = 50_000_000
CHANNELS = ("proposal", "emergency_stop", "stranger", "", "pose ")
SIZES = {"int32": (4, "i"), "uint32": (4, "I"), "double": (8, "d"), "boolean": (1, "?")}


class Result(NamedTuple):
    """lies: what was accepted and not said, with the input's number."""

    inputs: int
    observations: int
    faults: int
    silent: int
    lies: list[str]


class Wrong(Exception):
    """The payload is no message of this type."""


def said(kind: str, data: bytes) -> dict[str, Any]:
    """The message, field by field. Raises Wrong."""
    if len(data) < 4 or data[0] != 0 or data[1] > 1:
        raise Wrong
    walker = _Walker(data, "<" if data[1] else ">")
    found: dict[str, Any] = walker.value(kind)
    left = len(data) - walker.at
    if left and not (left < 4 and len(data) % 4 == 0):
        raise Wrong
    return found


class _Walker:
    """Takes values off a payload, by the table of fields."""

    def __init__(self, data: bytes, order: str) -> None:
        self.data, self.order, self.at = data, order, 4

    def value(self, kind: str) -> Any:
        base, added, count = element(kind)
        if not added:
            return self._one(base)
        if not count:
            count = self._basic("uint32")
            if count > len(self.data):
                raise Wrong
        return [self._one(base) for _ in range(count)]

    def _one(self, kind: str) -> Any:
        if kind == "string":
            return self._text()
        if kind in SIZES:
            return self._basic(kind)
        return {name: self.value(inner) for name, inner in FIELDS[kind]}

    def _basic(self, kind: str) -> Any:
        size, letter = SIZES[kind]
        while (self.at - 4) % size:
            self.at += 1
        raw = self.data[self.at : self.at + size]
        if len(raw) < size:
            raise Wrong
        self.at += size
        return struct.unpack(self.order + letter, raw)[0]

    def _text(self) -> str:
        length = self._basic("uint32")
        raw = self.data[self.at : self.at + length]
        if len(raw) < length or length > 256 or (length and (raw[-1] or 0 in raw[:-1])):
            raise Wrong
        self.at += length
        try:
            return raw[:-1].decode()
        except UnicodeDecodeError:
            raise Wrong from None


def poses(pose: str, payload: bytes) -> list[tuple[float, ...]]:
    """(x, y, theta, speed, w, stamp) of every pose that may be accepted of this payload. NaN where the message has no such thing."""
    try:
        told = said(KINDS[pose], payload)
    except Wrong:
        return []
    found = []
    for one in told["transforms"] if pose == "tf" else [told]:
        if pose == "odometry":
            place, turned, twist = one["pose"]["pose"]["position"], one["pose"]["pose"]["orientation"], one["twist"]["twist"]
        elif pose == "tf":
            place, turned, twist = one["transform"]["translation"], one["transform"]["rotation"], {}
        else:
            place, turned, twist = one["pose"]["position"], one["pose"]["orientation"], {}
        header = one["header"]
        stamp = header["stamp"]["sec"] * 10**9 + header["stamp"]["nanosec"]
        frames = (header["frame_id"].lstrip("/"), one.get("child_frame_id", CHILD).lstrip("/"))
        q = [turned[name] for name in "xyzw"]
        numbers = [*place.values(), *q, *([twist["linear"]["x"], twist["angular"]["z"]] if twist else [])]
        sane = all(math.isfinite(n) and abs(n) <= 1e7 for n in numbers)
        if not sane or frames != (FRAME, CHILD) or stamp <= 0 or header["stamp"]["nanosec"] >= 10**9 or header["stamp"]["sec"] < 0:
            continue
        length = math.sqrt(sum(value * value for value in q))
        if abs(length - 1.0) > 0.01 + 1e-12:
            continue
        x, y, z, w = (value / length for value in q)
        # columns of the rotation matrix: where the body's x axis points, and how upright its z axis is
        ahead, aside, up = 1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 1 - 2 * (x * x + y * y)
        if up < math.cos(TILT) - 1e-9:
            continue
        speeds = (twist["linear"]["x"], twist["angular"]["z"]) if twist else (math.nan, math.nan)
        found.append((place["x"], place["y"], math.atan2(aside, ahead), *speeds, stamp))
    return found


def payload_of(data: bytes) -> bytes:
    """What is behind the attachment; empty if there is none."""
    length = int.from_bytes(data[:2], "little")
    return data[2 + length :] if len(data) >= 2 + length else b""


class Source:
    """Inputs: a robot's own frames, and what becomes of them."""

    def __init__(self, pose: str, draw: random.Random, *, rmw: bool) -> None:
        self._pose, self._draw, self._rmw = pose, draw, rmw
        self._k = 0
        self.now_ns = 10**9
        self._pool: list[bytes] = [b"\0\1\0\0"]
        self._gid = draw.randbytes(16)

    def payload(self) -> bytes:
        """The next pose of a sound robot, or of one that is nearly so."""
        draw = self._draw
        self._k += 1
        half = draw.uniform(-math.pi, math.pi) / 2.0
        lean = draw.choice((0.0, 0.0, 0.0, draw.uniform(-0.3, 0.3)))
        size = draw.choice((1.0, 1.0, 1.0, draw.uniform(0.9, 1.1)))
        q = tuple(size * v for v in (math.sin(lean) * math.cos(half), 0.0, math.sin(half), math.cos(lean) * math.cos(half)))
        position = [draw.uniform(-3.0, 3.0) for _ in range(3)]
        twist = [draw.uniform(-1.0, 1.0) for _ in range(6)]
        if draw.random() < 0.1:
            spoilt = draw.choice((position, twist))
            spoilt[draw.randrange(len(spoilt))] = draw.choice(SPECIAL)
        stamp = 1_700_000_000 * 10**9 + self._k * PERIOD_NS
        frame, child = draw.choice((FRAME,) * 12 + ("map", "", "/odom")), draw.choice((CHILD,) * 12 + ("base_link", ""))
        at = Located(stamp, frame, child, tuple(position), q, tuple(twist))
        big = draw.random() < 0.3
        if self._pose == "odometry":
            return encode_odometry(at, big=big)
        if self._pose == "pose_stamped":
            return encode_pose_stamped(at, big=big)
        return encode_transforms([at._replace(child=f"wheel_{i}") for i in range(draw.randrange(3))] + [at], big=big)

    def frame(self) -> Frame:
        """One input."""
        draw = self._draw
        payload = self.payload() if draw.random() < 0.8 else draw.choice(self._pool)
        self._pool = [*self._pool[-50:], payload]
        if draw.random() < 0.5:
            payload = self._spoilt(payload)
        gid = self._gid if draw.random() < 0.98 else draw.randbytes(16)
        sequence = self._k if draw.random() < 0.98 else draw.randrange(-5, 2**40)
        extra = attachment(sequence, self.now_ns, gid) if self._rmw else b""
        data = envelope(extra if draw.random() < 0.98 else draw.randbytes(draw.randrange(60)), payload)
        roll = draw.random()
        if roll < 0.02:
            data = data[: draw.randrange(len(data) + 1)]
        elif roll < 0.03:
            data = draw.randbytes(draw.randrange(200))
        self.now_ns += draw.choice((PERIOD_NS, PERIOD_NS, PERIOD_NS, 10, 20 * PERIOD_NS))
        channel = "pose" if draw.random() < 0.97 else draw.choice(CHANNELS)
        if channel == "proposal" and draw.random() < 0.5:
            data = envelope(extra, encode_twist(tuple(draw.choice((*SPECIAL, 0.5)) for _ in range(6))))
        elif channel == "emergency_stop" and draw.random() < 0.5:
            data = envelope(extra, encode_bool(draw.random() < 0.5))
        return Frame(self.now_ns, channel, data)

    def _spoilt(self, payload: bytes) -> bytes:
        draw, data = self._draw, bytearray(payload)
        match draw.randrange(8):
            case 0:
                for _ in range(draw.randint(1, 5)):
                    data[draw.randrange(len(data))] ^= 1 << draw.randrange(8)
            case 1:
                for _ in range(draw.randint(1, 4)):
                    data[draw.randrange(len(data))] = draw.randrange(256)
            case 2:
                return bytes(data[: draw.randrange(len(data) + 1)])
            case 3:
                return bytes(data) + draw.randbytes(draw.randint(1, 12))
            case 4:  # a length or a count that is huge, or off by a little
                at = 4 * draw.randrange(1, max(2, min(len(data), 80) // 4))
                order = "<" if data[1:2] == b"\1" else ">"
                data[at : at + 4] = struct.pack(order + "I", draw.choice((0, 1, 5, 255, 257, 2**31, 2**32 - 1, draw.randrange(64))))
            case 5:  # a number that is none, somewhere among the numbers
                at = len(data) - 8 * draw.randrange(1, max(2, len(data) // 8))
                order = "<" if data[1:2] == b"\1" else ">"
                data[at : at + 8] = struct.pack(order + "d", draw.choice(SPECIAL))
            case 6:
                data[:4] = draw.choice((b"\0\0\0\0", b"\0\1\0\0", b"\0\2\0\0", b"\0\3\0\0", b"\0\7\0\0", b"\0\1\0\3", draw.randbytes(4)))
            case _:
                return draw.choice(self._pool)
        return bytes(data)


def options_of(pose: str, *, rmw: bool) -> dict[str, Any]:
    """The transport's."""
    return {
        "robot_listen": "tcp/127.0.0.1:1",
        "layout": "rmw" if rmw else "bridge",
        "pose": pose,
        "frame": FRAME,
        "child_frame": "" if pose == "pose_stamped" else CHILD,
        "max_tilt": TILT,
        "max_age": 1e9,
        "emergency_stop": "e_stop",
    }


def fuzz(inputs: int, seed: int, pose: str, *, rmw: bool) -> Result:
    """Feeds so many inputs to decoders, a fresh one now and then."""
    draw = random.Random(f"{seed}/{pose}/{rmw}")
    states = STATES if pose == "odometry" else STATES[:3]
    observations = faults = silent = 0
    lies: list[str] = []
    transport, source, newest = Ros2Transport(options_of(pose, rmw=rmw), states, INPUTS), Source(pose, draw, rmw=rmw), -1
    for number in range(inputs):
        if number and number % ANEW == 0:
            transport, source, newest = Ros2Transport(options_of(pose, rmw=rmw), states, INPUTS), Source(pose, draw, rmw=rmw), -1
        frame = source.frame()
        told = transport.decode(frame)
        silent += not told
        for message in told:
            if isinstance(message, Observation) and message.fault:
                faults += 1
            elif isinstance(message, Observation):
                observations += 1
                if not _is_said(message.x, poses(pose, payload_of(frame.data))):
                    lies.append(f"{pose} input {number}: {message.x} was not said")
                if message.stamp_ns <= newest:
                    lies.append(f"{pose} input {number}: the stamp fell to {message.stamp_ns}")
                newest = message.stamp_ns
            elif isinstance(message, Command) and not message.fault and not all(map(math.isfinite, message.u)):
                lies.append(f"{pose} input {number}: a command of {message.u}")
    return Result(inputs, observations, faults, silent, lies)


def _is_said(x: tuple[float, ...], told: list[tuple[float, ...]]) -> bool:
    """Numbers that stand in the message are the very same; the heading is computed."""
    return any(
        all((math.isclose(a, b, abs_tol=1e-9) if i == 2 else a == b) for i, (a, b) in enumerate(zip(x, one, strict=False))) for one in told
    )


def main() -> int:
    """Exit 1 if anything was accepted that nobody said."""
    parser = argparse.ArgumentParser(description="fuzzes the ROS 2 transport's decoder")
    parser.add_argument("--inputs", type=int, default=1_000_000, help="(default %(default)s)")
    parser.add_argument("--quick", action="store_true", help="a smoke run: 20 000 inputs")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.add_argument("--seed", type=int, default=1)
    args = parser.parse_args()
    told, lies = {}, []
    cases = [(pose, rmw) for pose in KINDS for rmw in (False, True)]
    for pose, rmw in cases:
        begin = time.process_time()
        found = fuzz(-(-(20_000 if args.quick else args.inputs) // len(cases)), args.seed, pose, rmw=rmw)
        name = f"{pose}, {'rmw' if rmw else 'bridge'}"
        told[name] = {**found._asdict(), "lies": len(found.lies), "crashes": 0, "cpu_s": round(time.process_time() - begin, 1)}
        lies += found.lies[:5]
        if not args.json:
            print(f"{name}: " + ", ".join(f"{key} {value}" for key, value in told[name].items()), flush=True)
    if args.json:
        print(json.dumps(told))
    for lie in lies:
        print(lie, file=sys.stderr)
    return 1 if lies else 0


if __name__ == "__main__":
    sys.exit(main())
