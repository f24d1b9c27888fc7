"""The MAVLink transport's figures: what it reads a second, what it does with spoilt bytes, with a cut link, and for ten minutes at 100 Hz.

    python tools/bench_mavlink.py [--quick] [--only parse|fuzz|cuts|hours|flood] [--json]

parse   messages a second of processor time through the transport (socket, checks, signature, clock, pose), beside pymavlink's parser alone
fuzz    a million spoilt inputs: exceptions (must be 0) and lies that were believed (must be 0: up to three flipped bits of unsigned frames,
        anything at all on a signed line)
cuts    a certified controller drives; the link is cut and restored a hundred times: when the gate closed, when it was open again
flood   floods on each line while a certified controller drives: the longest processor time of a turn of the loop that runs the gate, ms
hours   ten minutes at 100 Hz, half sampling, half driving: every position that the robot sent is an observation or counted; processor

The robot is the stand-in rover, a process of its own. Exit 1 if anything that must be 0 is not, or a figure misses its target.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import math
import os
import random
import socket
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parent.parent
sys.path[:0] = [str(ROOT / "tests" / "rigs"), str(ROOT / "tools")]

MS = 1_000_000
KEY = bytes(range(32))
STATES, INPUTS = ("x", "y", "theta"), ("v", "w")
LIE = 900.0


# ---------------------------------------------------------------- parse


def frames_of(count: int, key: bytes | None) -> list[bytes]:
    """Attitudes and positions in turns, with a heartbeat now and then, as pymavlink packs them."""
    from s2r_mavlink.rover_lines import UdpLine
    from s2r_mavlink.signing import stamp_of
    from s2r_mavlink.testing import Robot, free_port

    line = UdpLine("127.0.0.1", free_port())
    robot = Robot(line)
    line.close()
    if key is not None:
        robot.mav.signing.secret_key, robot.mav.signing.sign_outgoing = key, True
        robot.mav.signing.timestamp = stamp_of(time.time()) + 10_000_000
    made: list[bytes] = []
    for k in range(count // 2):
        if k % 20 == 0:
            made.append(robot.pack(robot.heartbeat()))
        made += [robot.pack(m) for m in robot.messages((1000 + 10 * k) * MS, (0.001 * (k % 1000), 0.5, 0.1))]
    return made


@contextlib.contextmanager
def opened(folder: Path, key: bytes | None) -> Iterator[tuple[Any, socket.socket]]:
    """A transport, and a socket that reaches it."""
    from s2r_mavlink.testing import free_port
    from s2r_mavlink.transport import MavlinkTransport

    port = free_port()
    options: dict[str, Any] = {"robot": f"udp:127.0.0.1:{port}", "max_age": 1e6, "queue": 1000}
    if key is not None:
        path = folder / "key"
        path.write_text(key.hex())
        path.chmod(0o600)
        options |= {"signing_key_file": str(path), "signing_state": str(folder / f"state-{time.monotonic_ns()}.json")}
    transport = MavlinkTransport(options, STATES, INPUTS)
    transport.open()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as robot:
        robot.connect(("127.0.0.1", port))
        try:
            yield transport, robot
        finally:
            transport.close()


def parse(count: int) -> dict[str, float]:
    """Messages a second of processor time."""
    from pymavlink.dialects.v20 import common as mavlink

    found: dict[str, float] = {}
    with tempfile.TemporaryDirectory(prefix="s2r-bench-") as name:
        for what, key in (("unsigned", None), ("signed", KEY)):
            frames = frames_of(count, key)
            with opened(Path(name), key) as (transport, robot):
                seconds, decoded = 0.0, 0
                for begin in range(0, len(frames), 60):
                    for frame in frames[begin : begin + 60]:
                        robot.send(frame)
                    before = time.process_time()
                    for one in transport.receive():
                        decoded += len(transport.decode(one))
                    seconds += time.process_time() - before
                assert decoded >= count // 2, "observations are missing"
                found[f"{what}_per_s"] = len(frames) / seconds
            reference = mavlink.MAVLink(None)
            reference.robust_parsing = True
            if key is not None:
                reference.signing.secret_key = key
            before = time.process_time()
            got = sum(len(reference.parse_buffer(frame) or []) for frame in frames)
            found[f"{what}_reference_per_s"] = got / (time.process_time() - before)
    return found


# ---------------------------------------------------------------- fuzz


def fuzz(count: int, seed: int) -> dict[str, float]:
    """Exceptions and believed lies, over so many inputs: half decoded as an audit would, half through a signed line's door."""
    from s2r_mavlink.testing import fuzzed
    from s2r_mavlink.transport import MavlinkTransport

    from s2r_runtime.messages import Command, Frame, Observation

    draw = random.Random(seed)
    honest = frames_of(200, None)
    exceptions = lies = nonfinite = 0
    transport = MavlinkTransport({"robot": "udp:127.0.0.1:1"}, STATES, INPUTS)
    for k in range(count // 2):
        channel = draw.choice(("robot", "robot", "robot", "ground", "companion", "door", "nonsense"))
        try:
            for message in transport.decode(Frame(k * MS, channel, fuzzed(draw, honest))):
                if isinstance(message, Observation | Command) and not message.fault:
                    values = message.x if isinstance(message, Observation) else message.u
                    nonfinite += not all(map(math.isfinite, values))
        except Exception:  # noqa: BLE001 - that is what is counted
            exceptions += 1
    lies += flips(count // 4, draw)
    found, wrong = through_a_signed_door(count // 4, draw)
    return {
        "inputs": float(count),
        "exceptions": float(exceptions),
        "not_finite": float(nonfinite),
        "lies": float(lies + wrong),
        "real_ones_heard": found,
    }


def flips(count: int, draw: random.Random) -> int:
    """Positions at 1000 m with up to three flipped bits, unsigned: how many were believed."""
    from s2r_mavlink.frames import is_frame
    from s2r_mavlink.rover_lines import UdpLine
    from s2r_mavlink.testing import Robot, flipped, free_port

    line = UdpLine("127.0.0.1", free_port())
    robot = Robot(line)
    line.close()
    lying = [robot.pack(m) for k in range(500) for m in robot.messages((1000 + 10 * k) * MS, (LIE + 100.0, LIE + 100.0, 1.0))]
    return sum(is_frame(flipped(draw, draw.choice(lying))) for _ in range(count))


def through_a_signed_door(count: int, draw: random.Random) -> tuple[float, int]:
    """Spoilt, forged and replayed frames between real ones, over a socket: (share of the real ones that were heard, lies believed)."""
    from s2r_mavlink.testing import fuzzed

    from s2r_runtime.messages import Observation

    real, forged = frames_of(2 * (count // 40), KEY), frames_of(400, bytes(range(1, 33)))
    wanted = count // 40
    heard: set[float] = set()
    wrong = 0
    with tempfile.TemporaryDirectory(prefix="s2r-bench-") as name, opened(Path(name), KEY) as (transport, robot):
        for k, frame in enumerate(real):
            robot.send(frame)
            for _ in range(20):
                way = draw.randrange(3)
                spoilt = fuzzed(draw, real[: k + 1]) if way == 0 else draw.choice(forged) if way == 1 else draw.choice(real[: k + 1])
                robot.send(spoilt[:60_000])
            for one in transport.receive():
                for message in transport.decode(one):
                    if isinstance(message, Observation) and not message.fault:
                        wrong += not (message.stamp_ns % (10 * MS) == 0 and message.stamp_ns not in heard)
                        heard.add(message.stamp_ns)
    return len(heard) / wanted, wrong


# ---------------------------------------------------------------- the daemon


class Bench:
    """A folder with a profile, a rover's process, and the daemon."""

    def __init__(self, folder: Path, dt: float, rate: float, loop_rate: float) -> None:
        from bench_daemon import Bench as DaemonBench
        from s2r_mavlink.testing import free_port

        self._inner = DaemonBench.__new__(DaemonBench)
        self._inner.folder, self._inner.dt, self._inner.clock = folder, dt, "realtime"
        self._inner.environment = {**os.environ, "XDG_RUNTIME_DIR": str(folder), "XDG_STATE_HOME": str(folder / "home")}
        port = free_port()
        self.wire = Wire(port)
        text = (ROOT / "profiles" / "rover-mavlink.toml").read_text()
        for old, new in (
            ('name = "rover"', 'name = "robotarium"'),  # the name under which the other benchmark's parts look for the socket
            ("dt = 0.1 ", f"dt = {dt} "),
            ("rate = 40.0", f"rate = {rate}"),
            ("udp:127.0.0.1:14551", f"udp:127.0.0.1:{port}"),
            ("stop_periods = 16", f"stop_periods = {round(1.6 / dt)}"),
            ("hold_periods = 20", f"hold_periods = {round(2.0 / dt)}"),
        ):
            assert old in text, old
            text = text.replace(old, new)
        self._inner.profile = self.profile = folder / "bench.toml"
        self.profile.write_text(text)
        self.folder, self._loop_rate = folder, loop_rate
        self.rover: Any = None

    def __getattr__(self, name: str) -> Any:
        return getattr(self._inner, name)

    def deploy(self, epoch: int) -> None:
        """A controller that goes round in circles, under a certificate whose evidence is made up."""
        from daemon_rig import made_up_certificate

        controller = self.folder / "circle.py"
        controller.write_text("import numpy as np\n\n\ndef control(x, theta, parameters):\n    return np.tile([0.4, 0.4], (len(x), 1))\n")
        key = self.folder / "state" / "key.pem"
        text = made_up_certificate(self.profile, key, controller, radius=100.0, verified=200.0, epoch=epoch)
        answer = self.ask("deploy", path=str(controller), certificate=text)
        if answer["exit_code"]:
            raise SystemExit(f"not deployed: {answer['text']}")

    def ready(self) -> None:
        """The robot comes once the daemon is there, so that all that it says can be heard; until it can be driven."""
        from s2r_mavlink.testing import RoverProcess

        self.ask("status")
        self.rover = RoverProcess(f"udpout:127.0.0.1:{self.wire.port}", "--loop-rate", str(self._loop_rate))
        limit = time.monotonic() + 60.0
        while time.monotonic() < limit:
            seen = self.status()["observation"]
            if seen and not seen["fault"]:
                return
            time.sleep(0.05)
        raise SystemExit(f"the robot was not found: {(self.folder / 'daemon.txt').read_text()}")

    def close(self) -> None:
        """Ends rover and wire."""
        if self.rover is not None:
            self.rover.end()
        self.wire.close()


class Wire:
    """A UDP hop between rover and runtime with a switch. `cut`: nothing passes. lost: datagrams that it did not pass."""

    def __init__(self, to: int) -> None:
        from s2r_mavlink.testing import free_port

        self.port, self.cut, self.lost = free_port(), threading.Event(), 0
        self._over = threading.Event()
        self._near, self._far = (socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(2))
        self._near.bind(("127.0.0.1", self.port))
        self._near.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 20)
        self._far.connect(("127.0.0.1", to))
        self._robot: Any = None
        self._threads = [threading.Thread(target=run, daemon=True) for run in (self._toward, self._back)]
        for one in (self._near, self._far):
            one.settimeout(0.2)
        for thread in self._threads:
            thread.start()

    def _toward(self) -> None:
        while not self._over.is_set():
            with contextlib.suppress(OSError):
                data, self._robot = self._near.recvfrom(65_536)
                if self.cut.is_set():
                    self.lost += 1
                else:
                    self._far.send(data)

    def _back(self) -> None:
        while not self._over.is_set():
            with contextlib.suppress(OSError):
                data = self._far.recv(65_536)
                if not self.cut.is_set() and self._robot is not None:
                    self._near.sendto(data, self._robot)

    def close(self) -> None:
        """Ends it."""
        self._over.set()
        for thread in self._threads:
            thread.join()
        self._near.close()
        self._far.close()


def gate_changes(log: Path) -> list[tuple[int, bool, str]]:
    """(host's monotonic clock, open, reason)."""
    from s2r_runtime.messages import GateChanged
    from s2r_runtime.recording.reading import read

    return [(m.t_ns, m.open, m.reason) for entry in read(log, ["out/gate_changed"]) if isinstance(m := entry.message, GateChanged)]


def cuts(count: int) -> dict[str, float]:
    """Seconds from cut to closed and from restored to open, over so many cuts."""
    draw = random.Random(7)
    events: list[tuple[int, int]] = []
    with tempfile.TemporaryDirectory(prefix="s2r-bench-") as name:
        bench = Bench(Path(name), 0.1, 40.0, 50.0)
        try:
            with bench.daemon():
                bench.ready()
                bench.deploy(1)
                bench.until("gate", "open")
                time.sleep(1.0)
                for _ in range(count):
                    bench.wire.cut.set()
                    cut_ns = time.monotonic_ns()
                    time.sleep(draw.uniform(0.6, 1.6))
                    bench.wire.cut.clear()
                    events.append((cut_ns, time.monotonic_ns()))
                    time.sleep(draw.uniform(1.2, 1.6))
            (log,) = bench.logs()
            changes = gate_changes(log)
        finally:
            bench.close()
    closed, healed = [], []
    for cut_ns, back_ns in events:
        closed.append(min((t for t, is_open, _ in changes if not is_open and cut_ns <= t <= back_ns), default=cut_ns + 10**12) - cut_ns)
        healed.append(min((t for t, is_open, _ in changes if is_open and t >= back_ns), default=back_ns + 10**12) - back_ns)
    return {
        "cuts": float(count),
        "closed_after_max_s": max(closed) * 1e-9,
        "closed_after_median_s": sorted(closed)[count // 2] * 1e-9,
        "open_after_max_s": max(healed) * 1e-9,
        "open_after_median_s": sorted(healed)[count // 2] * 1e-9,
    }


def hours(seconds: float) -> dict[str, float]:
    """At 100 Hz: the share of a core, and what became of every position that the robot sent."""
    from bench_daemon import measured

    with tempfile.TemporaryDirectory(prefix="s2r-bench-") as name:
        bench = Bench(Path(name), 0.01, 100.0, 200.0)
        try:
            with bench.daemon(), ThreadPoolExecutor(1) as pool:
                bench.ready()
                bench.deploy(1)
                bench.until("gate", "open")
                driving = measured(bench, seconds / 2)  # type: ignore[arg-type]
                bench.ask("undeploy")
                bench.ask("permit", duration_s=36_000.0)
                campaign = pool.submit(bench.ask, "sample")
                bench.until("driving", "sampler")
                sampling = measured(bench, seconds / 2)  # type: ignore[arg-type]
                bench.ask("cancel")
                campaign.result()
                bench.rover.tell("quit")
                limit = time.monotonic() + 10.0
                while not any("sent" in line for line in bench.rover.said) and time.monotonic() < limit:
                    time.sleep(0.05)
                time.sleep(1.0)
                status = bench.status()
            sent = next(line["sent"] for line in bench.rover.said if "sent" in line)
        finally:
            bench.close()
    counters, seen = status["counters"], status["observation"]["seq"]
    unread = {name: counters[name] for name in ("lost", "dropped_in", "old", "ahead", "unpaired", "malformed", "out_of_order", "repeated")}
    explained = sum(counters[name] for name in ("lost", "dropped_in", "old", "ahead", "unpaired", "out_of_order", "repeated"))
    return {
        "positions_sent": float(sent["LOCAL_POSITION_NED"]),
        "observations": float(seen),
        "stale": float(counters["stale"]),
        "frames_sent": float(sum(sent.values())),
        "frames_received": float(counters["received"]),
        "unexplained_frames": float(sum(sent.values()) - counters["received"] - max(counters["lost"], counters["overflowed"])),
        "unexplained_positions": float(max(0, sent["LOCAL_POSITION_NED"] - seen - explained)),
        **{f"counted_{name}": float(value) for name, value in unread.items()},
        "messages_per_s": driving["observations_per_s"],
        "driving_daemon_core": driving["daemon_core"],
        "driving_analytics_core": driving["analytics_core"],
        "sampling_daemon_core": sampling["daemon_core"],
        "sampling_analytics_core": sampling["analytics_core"],
    }


def floods(seconds: float) -> dict[str, float]:
    """The longest processor time of a turn, ms, for each flood; and how often the gate did not stand open after one."""
    from mavlink_floods import FLOODS, held_s

    found, closed = {}, 0
    for name, flood in FLOODS.items():
        with tempfile.TemporaryDirectory(prefix="s2r-bench-") as folder:
            held, gate = held_s(Path(folder), flood, seconds)
        found[f"held_ms ({name})"] = 1e3 * held
        closed += gate != "open"
    return found | {"gate_closed_after_flood": float(closed)}


# ---------------------------------------------------------------- the table


def main() -> int:
    """Exit 0 if every figure meets its target."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="a smoke run")
    parser.add_argument("--only", choices=("parse", "fuzz", "cuts", "hours", "flood"))
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args()
    quick = args.quick
    runs = {
        "parse": lambda: parse(20_000 if quick else 200_000),
        "fuzz": lambda: fuzz(20_000 if quick else 1_000_000, 1),
        "cuts": lambda: cuts(3 if quick else 100),
        "hours": lambda: hours(10.0 if quick else 600.0),
        "flood": lambda: floods(2.0 if quick else 20.0),
    }
    found: dict[str, dict[str, float]] = {}
    bad = []
    for name, run in runs.items():
        if args.only in (None, name):
            found[name] = run()
            bad += [line(name, what, value, quiet=args.json) for what, value in found[name].items()]
    if args.json:
        print(json.dumps(found))
    return 1 if any(bad) else 0


AT_LEAST = {"unsigned_per_s": 50_000.0, "signed_per_s": 50_000.0, "real_ones_heard": 0.999}
AT_MOST = {
    "exceptions": 0.0, "not_finite": 0.0, "lies": 0.0,
    "closed_after_max_s": 0.4,  # the gate's time-out is 0.3 s, its clock ticks every 20 ms, and the last observation may be a period old
    "open_after_max_s": 1.0,
    "unexplained_frames": 0.0, "unexplained_positions": 0.0,
    "gate_closed_after_flood": 0.0,
    "driving_daemon_core": 0.15, "sampling_daemon_core": 0.15,
}  # fmt: skip


def line(part: str, what: str, value: float, *, quiet: bool) -> bool:
    """Prints a figure; whether it misses its target."""
    low, high = AT_LEAST.get(what), 20.0 if what.startswith("held_ms") else AT_MOST.get(what)
    bad = (low is not None and value < low) or (high is not None and value > high)
    wanted = f"  (at least {low:g})" if low is not None else f"  (at most {high:g})" if high is not None else ""
    if not quiet:
        print(f"{part:6s} {what:52s} {value:14.4f}{wanted}{'  MISSED' if bad else ''}", flush=True)
    return bad


if __name__ == "__main__":
    raise SystemExit(main())
