"""Every transport's link: cut and restored again and again, and ten minutes at 100 Hz.

    python tools/bench_links.py [cuts|rate ...] [--only zenoh mavlink can ros2] [--cuts N] [--seconds S] [--json]

cuts    a certified controller drives; the link is cut and restored (really: the way between the two processes is gone, or silent). When the
        gate was closed after the last observation, and when the robot was heard again after the link's return. From the log's own stamps
rate    the daemon drives half of the time and samples the other half, with a robot at 100 Hz: what the robot sent is an observation, or
        counted as lost (in the runtime's queue, or before it came: a robot's publisher drops what a congested link does not take);
        commands that were decided are sent, or counted as dropped; the daemon's share of a core

The robots are the stand-ins, processes of their own: Zenoh and ROS 2 over a TCP hop that closes its connections (even cuts) or passes
nothing (odd cuts), MAVLink over a UDP hop that passes nothing, CAN over a network interface that is taken down. One transport after the
other. Exit 1 if a figure misses its target. Nothing here is a guarantee of time: figures of a busy machine are a busy machine's.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import random
import selectors
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parent.parent
sys.path[:0] = [str(ROOT / "tests" / "rigs"), str(ROOT / "tools")]

DT = 0.01
TIMEOUT_S = 0.1
"""The gate's observation_timeout here: ten periods."""
CLOSED_S = TIMEOUT_S + 0.04
"""A tick of 20 ms to notice, one more for a machine that is late. No command passes that long: each is judged by the observation's age."""
HEALED_S, CORE = 1.0, 0.15
TURN = "import numpy as np\n\n\ndef control(x, theta, parameters):\n    return np.tile([0.0, 0.5], (len(x), 1))\n"


class Hop:
    """A TCP way to 127.0.0.1:to that can be cut: `cut` closes what is open and takes nothing new, `silence` passes nothing."""

    def __init__(self, to: int, port: int) -> None:
        self._to, self.port = to, port
        self._over, self._silent = threading.Event(), threading.Event()
        self._selector = selectors.DefaultSelector()
        self._lock = threading.Lock()
        self._listener: socket.socket | None = None
        self.restore()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def cut(self) -> None:
        """Ends every connection and refuses new ones, as a switch that lost its power."""
        with self._lock:
            for key in list(self._selector.get_map().values()):
                self._selector.unregister(key.fileobj)
                key.fileobj.close()  # type: ignore[union-attr]
            self._listener = None

    def silence(self) -> None:
        """Passes nothing on, but keeps every connection: as a cable that was pulled."""
        self._silent.set()

    def restore(self) -> None:
        """As before the cut or the silence."""
        self._silent.clear()
        with self._lock:
            if self._listener is None:
                self._listener = socket.create_server(("127.0.0.1", self.port))
                self._selector.register(self._listener, selectors.EVENT_READ, None)

    def close(self) -> None:
        """Ends its thread and every connection."""
        self._over.set()
        self._thread.join()
        self.cut()

    def _run(self) -> None:
        while not self._over.is_set():
            if self._silent.is_set() or self._listener is None:
                time.sleep(0.002)
                continue
            for key, _ in self._selector.select(0.02):
                with self._lock, contextlib.suppress(OSError, KeyError, ValueError):
                    self._pass(key)

    def _pass(self, key: selectors.SelectorKey) -> None:
        if key.data is None:
            near, _ = key.fileobj.accept()  # type: ignore[union-attr]
            try:
                far = socket.create_connection(("127.0.0.1", self._to), 1.0)
            except OSError:
                near.close()
                return
            for one, other in ((near, far), (far, near)):
                one.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                self._selector.register(one, selectors.EVENT_READ, other)
            return
        data = key.fileobj.recv(65_536)  # type: ignore[union-attr]
        if data:
            key.data.sendall(data)
            return
        for one in (key.fileobj, key.data):
            self._selector.unregister(one)
            one.close()  # type: ignore[union-attr]


def free_port() -> int:
    """A TCP port of the loopback that nobody uses at this moment."""
    with socket.socket() as s:
        s.bind(("127.0.0.1", 0))
        return int(s.getsockname()[1])


# ---------------------------------------------------------------- robots behind a TCP hop


class Bench:
    """A daemon, a stand-in at 100 Hz in real time, and the hop between them."""

    def __init__(self, folder: Path, transport: str) -> None:
        from daemon_rig import Rig

        self.rig = Rig(folder, clock="realtime")
        direct, hop = free_port(), free_port()
        if transport == "zenoh":
            text = self.rig.profile.read_text()
            changes = {
                "dt = 0.033": f"dt = {DT}",
                "delay = 0.033": f"delay = {DT}",
                'name = "loop"\nfolder = "."': f'name = "zenoh"\nrobot_listen = "tcp/127.0.0.1:{direct}"',
            }
            self._argv = ["-m", "s2r_standins.robotarium", "--realtime", "--connect", f"tcp/127.0.0.1:{hop}", "--period", str(DT)]
        else:
            text = (ROOT / "profiles" / "turtlebot-ros2-zenoh.toml").read_text()
            changes = {
                'name = "turtlebot-ros2-zenoh"': 'name = "rig"',
                "dt = 0.05 ": f"dt = {DT} ",
                "delay = 0.05 ": f"delay = {DT} ",
                "tcp/127.0.0.1:7447": f"tcp/127.0.0.1:{hop}",
                'controller_listen = "tcp/127.0.0.1:7448"': "",
                "period = 0.05 ": f"period = {DT} ",
                "observation_timeout = 0.3 ": "observation_timeout = 0.5 ",
                "controller_deadline = 0.04": "controller_deadline = 0.5",
                "observation_timeout = 0.2 ": "observation_timeout = 0.5 ",
            }
            self._argv = ["-m", "s2r_ros2.standin", "--listen", f"tcp/127.0.0.1:{direct}", "--period", str(DT)]
        changes["controller_deadline = 0.5"] = "controller_deadline = 5.0"  # a busy machine's controller is no fault of the link's
        for old, new in changes.items():
            if old not in text:
                raise SystemExit(f"{transport}: the profile has no {old!r} any more")
            text = text.replace(old, new)
        head, transport_table = text.split("\n[transport]\n")
        self.rig.profile.write_text(
            head.replace("observation_timeout = 0.5", f"observation_timeout = {TIMEOUT_S}") + "\n[transport]\n" + transport_table
        )
        self.hop = Hop(direct, hop)

    def __enter__(self) -> Bench:
        self.rig.start()
        with (self.rig.folder / "robot.txt").open("ab") as said:
            argv = [sys.executable, *self._argv, "--parent", str(os.getpid())]
            self.rig.robot = subprocess.Popen(argv, stdin=subprocess.PIPE, stdout=said, stderr=said)
        self.until(lambda s: s["link"] and s["observation"] and not s["observation"]["fault"])
        return self

    def __exit__(self, *_: object) -> None:
        self.rig.close()
        self.hop.close()

    def status(self) -> dict[str, Any]:
        """What `s2r status --json` shows."""
        return self.rig.status()

    def until(self, ready: Callable[[dict[str, Any]], Any]) -> None:
        """Waits until the status is so; raises AssertionError if that takes too long."""
        self.rig.until(lambda: ready(self.rig.status()))

    def drive(self) -> None:
        """A controller that turns on the spot, under a certificate whose evidence is made up; returns when the gate is open."""
        from daemon_rig import made_up_certificate

        law = self.rig.folder / "turn.py"
        law.write_text(TURN)
        key, weights = self.rig.state / "key.pem", (1.0, 1.0, 0.08 if "ros2" in self._argv[1] else 0.0525)
        text = made_up_certificate(self.rig.profile, key, law, radius=1.0, verified=2.0, epoch=1, weights=weights)
        answer = self.rig.ask("deploy", path=str(law), certificate=text)
        if answer["exit_code"]:
            raise SystemExit(f"not deployed: {answer['text']}")
        self.until(lambda s: s["gate"] == "open")


def cuts(transport: str, number: int) -> dict[str, Any]:
    """When the gate was closed after the last observation, and when one came after the link's return; s."""
    from s2r_runtime.messages import GateChanged, Observed

    draw, at = random.Random(5), []
    with tempfile.TemporaryDirectory(prefix="s2r-links-") as name, Bench(Path(name), transport) as bench:
        bench.drive()
        for k in range(number):
            cut_ns = time.monotonic_ns()
            (bench.hop.silence if k % 2 else bench.hop.cut)()
            time.sleep(draw.uniform(0.3, 1.2))
            bench.hop.restore()
            at.append((cut_ns, time.monotonic_ns()))
            bench.until(lambda s: s["gate"] == "open")
            time.sleep(draw.uniform(0.1, 0.4))
        bench.rig.stop()
        entries: list[Any] = bench.rig.messages("event/observed", "out/gate_changed")
    closed, heard, opened = [], [], []
    good = [m.t_ns for m in entries if isinstance(m, Observed) and not m.observation.fault]
    gates = [(m.t_ns, m.open) for m in entries if isinstance(m, GateChanged)]
    for cut_ns, back_ns in at:
        shut = min((t for t, is_open in gates if not is_open and cut_ns <= t), default=cut_ns + 10**12)
        closed.append((shut - max(t for t in good if t <= shut)) * 1e-9)
        heard.append((min((t for t in good if t >= back_ns), default=back_ns + 10**12) - back_ns) * 1e-9)
        opened.append((min((t for t, is_open in gates if is_open and t >= back_ns), default=back_ns + 10**12) - back_ns) * 1e-9)
    return summed(number, closed, CLOSED_S, heard, opened)


def summed(number: int, closed: list[float], limit: float, heard: list[float], opened: list[float]) -> dict[str, Any]:
    """Medians and largest values."""
    return {
        "cuts": number,
        "closed_median_s": sorted(closed)[len(closed) // 2],
        "closed_max_s": max(closed),
        "closed_must_s": limit,
        "healed_median_s": sorted(heard)[len(heard) // 2],
        "healed_max_s": max(heard),
        "open_again_max_s": max(opened),
    }


def rate(transport: str, seconds: float) -> dict[str, Any]:
    """What became of every observation and command, and the daemon's share of a core."""
    from bench_daemon import measured

    from s2r_runtime.messages import Observed, Send

    with tempfile.TemporaryDirectory(prefix="s2r-links-") as name, Bench(Path(name), transport) as bench, ThreadPoolExecutor(1) as pool:
        bench.drive()
        driving = measured(bench, seconds / 2)  # type: ignore[arg-type]
        bench.rig.ask("undeploy")
        bench.rig.ask("permit", duration_s=36_000.0)
        campaign = pool.submit(bench.rig.ask, "sample", count=20_000)
        bench.until(lambda s: s["driving"] == "sampler")
        sampling = measured(bench, seconds / 2)  # type: ignore[arg-type]
        bench.rig.ask("cancel")
        campaign.result()
        bench.rig.robot.kill()  # type: ignore[union-attr]
        time.sleep(1.0)
        counters, then_ns = bench.status()["counters"], time.monotonic_ns()
        bench.rig.stop()
        observed = [m.observation for m in bench.rig.messages("event/observed") if isinstance(m, Observed)]
        sends = sum(isinstance(m, Send) and m.t_ns < then_ns for m in bench.rig.messages("out/send"))
    numbers = {o.seq for o in observed}  # late ones are faulty, and numbered
    missing = max(numbers) - min(numbers) + 1 - len(numbers) - counters.get("restarts", 0)
    return {
        "seconds": seconds,
        "observations": sum(not o.fault for o in observed),
        "faulty": sum(bool(o.fault) for o in observed),
        "missing_by_their_count": missing,
        "lost_and_counted": counters["lost"],
        "dropped_and_counted": counters["dropped_in"],
        "lost_before_it_came": counters["lost"] - counters["dropped_in"],
        "unexplained": abs(missing - counters["lost"]),
        "commands": sends,
        "commands_dropped_and_counted": counters["dropped_out"],
        "commands_unexplained": abs(sends - counters["sent"] - counters["dropped_out"]),
        "driving_core": driving["daemon_core"],
        "sampling_core": sampling["daemon_core"],
    }


# ---------------------------------------------------------------- those that have a bench of their own


def inside(call: str) -> dict[str, Any]:
    """A call of bench_can, in a network namespace of its own, where the bus is multicast and a cut takes the interface down."""
    import bench_can

    tools = {"PYTHONPATH": os.pathsep.join([str(ROOT / "tools"), str(ROOT / "tests" / "rigs")]), bench_can.INSIDE: "1"}
    code = f"import bench_can, json; print(json.dumps(bench_can.{call}))"
    argv = [*bench_can.ENTER, f'{bench_can.LO_UP}; exec "$0" "$@"', sys.executable, "-c", code]
    ran = subprocess.run(argv, env={**os.environ, **tools}, stdout=subprocess.PIPE, text=True, check=False)
    if ran.returncode:
        raise SystemExit("CAN needs a network namespace of its own: unshare --net, and ip, must work here")
    return dict(json.loads(ran.stdout))


def can_cuts(number: int) -> dict[str, Any]:
    """As `cuts`, over CAN: the figures of bench_can, in a network namespace of its own."""
    found = inside(f"cuts({number})")
    shut, back = found["gate_closed_after_s"], found["healed_after_s"]
    return {
        "cuts": number,
        "closed_median_s": shut["median"],
        "closed_max_s": shut["max"],
        "closed_must_s": shut["must_be"],
        "healed_median_s": back["median"],
        "healed_max_s": back["max"],
    }


def mavlink_cuts(number: int) -> dict[str, Any]:
    """As `cuts`, over MAVLink: the figures of bench_mavlink."""
    import bench_mavlink

    found = bench_mavlink.cuts(number)
    return {
        "cuts": number,
        "closed_median_s": found["closed_after_median_s"],
        "closed_max_s": found["closed_after_max_s"],
        "closed_must_s": bench_mavlink.AT_MOST["closed_after_max_s"],
        "healed_median_s": found["open_after_median_s"],
        "healed_max_s": found["open_after_max_s"],
    }


def can_rate(seconds: float) -> dict[str, Any]:
    """As `rate`, over CAN: the figures of bench_can, in a network namespace of its own."""
    found = inside(f"at_100_hz({seconds})")
    return {
        "seconds": seconds,
        "observations": found["observations"],
        "lost_and_counted": found["frames_lost_by_their_counters"],
        "dropped_and_counted": found["frames_dropped_and_counted"],
        "unexplained": found["frames_unexplained"] + max(0, found["gaps_unexplained"]) + found["observations_unexplained"],
        "commands": found["commands_decided"],
        "commands_dropped_and_counted": found["commands_dropped_and_counted"],
        "driving_core": found["driving_daemon_core"],
        "sampling_core": found["sampling_daemon_core"],
    }


def mavlink_rate(seconds: float) -> dict[str, Any]:
    """As `rate`, over MAVLink: the figures of bench_mavlink."""
    import bench_mavlink

    found = bench_mavlink.hours(seconds)
    return {
        "seconds": seconds,
        "observations": int(found["observations"]),
        "lost_and_counted": int(found["counted_lost"]),
        "dropped_and_counted": int(found["counted_dropped_in"]),
        "unexplained": int(found["unexplained_frames"] + found["unexplained_positions"]),
        "driving_core": found["driving_daemon_core"],
        "sampling_core": found["sampling_daemon_core"],
    }


TRANSPORTS: dict[str, tuple[Callable[[int], dict[str, Any]], Callable[[float], dict[str, Any]]]] = {
    "zenoh": (lambda n: cuts("zenoh", n), lambda s: rate("zenoh", s)),
    "mavlink": (mavlink_cuts, mavlink_rate),
    "can": (can_cuts, can_rate),
    "ros2": (lambda n: cuts("ros2", n), lambda s: rate("ros2", s)),
}


def misses(what: str, found: dict[str, Any]) -> Iterator[str]:
    """Targets that a figure misses."""
    if what == "cuts":
        if found["closed_max_s"] > found["closed_must_s"]:
            yield "the gate closed late"
        if found["healed_max_s"] > HEALED_S:
            yield "healed late"
        return
    if found["unexplained"] or found.get("commands_unexplained"):
        yield "losses unexplained"
    if max(found["driving_core"], found["sampling_core"]) > CORE:
        yield f"more than {CORE:.0%} of a core"


def main() -> int:
    """Exit 0 if every figure meets its target."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", nargs="*", metavar="cuts|rate", help="default: both")
    parser.add_argument("--only", nargs="+", choices=tuple(TRANSPORTS), default=list(TRANSPORTS))
    parser.add_argument("--cuts", type=int, default=100)
    parser.add_argument("--seconds", type=float, default=600.0)
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args()
    if wrong := set(args.what) - {"cuts", "rate"}:
        parser.error(f"{min(wrong)}: must be cuts or rate")
    found: dict[str, dict[str, Any]] = {}
    bad = False
    for name in args.only:
        found[name] = {}
        for what, number, run in (("cuts", args.cuts, TRANSPORTS[name][0]), ("rate", args.seconds, TRANSPORTS[name][1])):
            if what not in (args.what or ("cuts", "rate")):
                continue
            figures = found[name][what] = run(number)
            figures["misses"] = list(misses(what, figures))
            bad = bad or bool(figures["misses"])
            if not args.json:
                said = "  ".join(f"{key} {value:.3f}" if isinstance(value, float) else f"{key} {value}" for key, value in figures.items())
                print(f"{name:8} {what}  {said}", flush=True)
    if args.json:
        print(json.dumps(found))
    return 1 if bad else 0


if __name__ == "__main__":
    raise SystemExit(main())
