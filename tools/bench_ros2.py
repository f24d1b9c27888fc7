"""The ROS 2 transport's figures: decoding, losses and load at 100 Hz, and links that are cut.

    python tools/bench_ros2.py [--quick] [--json] [--seconds S] [--cuts N] [--layout bridge|rmw]

1. decoding: messages a second (CPU time) through `Ros2Transport.decode`: Odometry under rmw, a TFMessage of ten transforms under the bridge
2. 100 Hz: the daemon gates a certified controller half of the time and samples the other half, on the stand-in robot; every pose and
   command is accounted for; the daemon's share of a core
3. cuts: the link is cut and restored again and again while a controller drives; how long the gate took to close and the link to heal

The link is cut by a relay on TCP that is between robot and runtime. Nothing here is a guarantee of time: figures of a busy machine are a
busy machine's.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import select
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
"""gate.observation_timeout here: the gate must be closed so long after the last observation, and a tick."""
TICK_S = 0.02
CLOSED_S = TIMEOUT_S + 2 * TICK_S
"""A tick to notice, and one more for a machine that is late. No command passes that long: each is judged by the observation's age."""
WEIGHTS = (1.0, 1.0, 0.08)
TURN = "import numpy as np\n\n\ndef control(x, theta, parameters):\n    return np.tile([0.0, 0.5], (len(x), 1))\n"


# ---------------------------------------------------------------- 1: decoding


def decoding(count: int) -> dict[str, float]:
    """Messages a second."""
    from s2r_ros2.keys import attachment, envelope
    from s2r_ros2.payloads import Located, encode_odometry, encode_transforms
    from s2r_ros2.transport import Ros2Transport

    from s2r_runtime.messages import Frame

    found = {}
    for name, options in (
        ("odometry_rmw", {"layout": "rmw"}),
        ("tf_of_ten_bridge", {"pose": "tf", "frame": "odom", "child_frame": "base_footprint"}),
    ):
        frames = []
        for k in range(count):
            at = Located(10**18 + k * 10**7, "odom", "base_footprint", (0.001 * k, 0.0, 0.0), (0.0, 0.0, 0.6, 0.8), (0.1,) * 6)
            if name == "odometry_rmw":
                data = envelope(attachment(k + 1, at.stamp_ns, bytes(16)), encode_odometry(at))
            else:
                data = envelope(b"", encode_transforms([at._replace(child=f"wheel_{i}_link") for i in range(9)] + [at]))
            frames.append(Frame(k * 10**7, "pose", data))
        best = 0.0
        for _ in range(3):
            transport = Ros2Transport({"robot_listen": "tcp/127.0.0.1:1", **options}, ("x", "y", "theta"), ("v", "w"))
            begin, said = time.process_time(), 0
            for frame in frames:
                said += len(transport.decode(frame))
            best = max(best, count / (time.process_time() - begin))
            assert said == count + 1, "one observation a message, and the link"
        found[f"{name}_per_s"] = best
    return found


# ---------------------------------------------------------------- a daemon and its robot


class Relay:
    """TCP from one port of loopback to another, which can be cut: what was connected is closed, and nobody gets in."""

    def __init__(self, to: int) -> None:
        self._to, self._open, self._over = to, True, False
        self._server = socket.create_server(("127.0.0.1", 0))
        self.port = self._server.getsockname()[1]
        self._pairs: dict[socket.socket, socket.socket] = {}
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def cut(self) -> None:
        """From now on."""
        self._open = False

    def restore(self) -> None:
        """Until now."""
        self._open = True

    def close(self) -> None:
        """Ends its thread, and listens no more."""
        self._over = True
        self._thread.join()
        self._server.close()

    def _run(self) -> None:
        while not self._over:
            if not self._open:
                for one in self._pairs:
                    one.close()
                self._pairs.clear()
            ready, _, _ = select.select([self._server, *self._pairs], [], [], 0.002)
            for one in ready:
                if one is self._server:
                    self._accept()
                elif one in self._pairs:
                    self._pass_on(one)
        for one in self._pairs:
            one.close()

    def _accept(self) -> None:
        near, _ = self._server.accept()
        if not self._open:
            near.close()
            return
        try:
            far = socket.create_connection(("127.0.0.1", self._to))
        except OSError:
            near.close()
            return
        for one, other in ((near, far), (far, near)):
            one.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self._pairs[one] = other

    def _pass_on(self, one: socket.socket) -> None:
        other = self._pairs[one]
        try:
            data = one.recv(65_536)
            if data:
                other.sendall(data)
                return
        except OSError:
            pass
        for end in (one, other):
            self._pairs.pop(end, None)
            end.close()


class Bench:
    """A folder, a relay, a stand-in robot at 100 Hz and a daemon that connects to it."""

    def __init__(self, folder: Path, layout: str) -> None:
        from s2r_zenoh.testing import free_endpoint

        self.folder, self.layout = folder, layout
        self.robots = free_endpoint()
        self.relay = Relay(int(self.robots.rpartition(":")[2]))
        text = (ROOT / "profiles" / "turtlebot-ros2-zenoh.toml").read_text()
        for old, new in (
            ("dt = 0.05 ", f"dt = {DT} "),
            ("delay = 0.05 ", f"delay = {DT} "),
            ("period = 0.05 ", f"period = {DT} "),
            ("observation_timeout = 0.2 ", f"observation_timeout = {TIMEOUT_S} "),
            ("observation_timeout = 0.3 ", "observation_timeout = 0.2 "),
            ("command_ttl = 0.15 ", "command_ttl = 0.5 "),  # nor is it when the controller answers late
            ("controller_deadline = 0.04", "controller_deadline = 5.0"),  # a busy machine's controller is no fault of the link's
            ('layout = "bridge" ', f'layout = "{layout}" '),
            ("tcp/127.0.0.1:7447", f"tcp/127.0.0.1:{self.relay.port}"),
            ("tcp/127.0.0.1:7448", free_endpoint()),
        ):
            assert text.count(old) == 1, old
            text = text.replace(old, new)
        self.profile = folder / "bench.toml"
        self.profile.write_text(text)
        self.environment = {**os.environ, "XDG_RUNTIME_DIR": str(folder), "XDG_STATE_HOME": str(folder / "home")}

    @contextlib.contextmanager
    def robot(self) -> Iterator[subprocess.Popen[str]]:
        """The robot; `quit` on its stdin makes it say its tally."""
        argv = [sys.executable, "-m", "s2r_ros2.standin", "--layout", self.layout, "--listen", self.robots, "--period", str(DT)]
        process = subprocess.Popen(argv, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        try:
            yield process
        finally:
            process.terminate()
            process.communicate()

    @contextlib.contextmanager
    def daemon(self) -> Iterator[subprocess.Popen[bytes]]:
        """The daemon as a process, its journal in `daemon.txt`; ended with SIGTERM on leaving."""
        argv = [sys.executable, "-m", "s2r_runtime.cli.main", "run", str(self.profile), "--state", str(self.folder / "state")]
        with (self.folder / "daemon.txt").open("ab") as sink:
            process = subprocess.Popen(argv, stdout=sink, stderr=sink, env=self.environment)
            try:
                yield process
            finally:
                process.terminate()
                process.wait(30.0)

    def ask(self, verb: str, **fields: Any) -> dict[str, Any]:
        """The daemon's answer to one request, once it listens (30 s at most)."""
        from s2r_runtime.daemon import control

        path, limit = self.folder / "s2r" / "turtlebot-ros2-zenoh.sock", time.monotonic() + 30.0
        while not control._listening(path) and time.monotonic() < limit:
            time.sleep(0.01)
        return control.call(path, {"verb": verb, **fields})

    def status(self) -> dict[str, Any]:
        """What `s2r status --json` shows."""
        return dict(self.ask("status")["data"])

    def until(self, ready: Callable[[dict[str, Any]], bool], seconds: float = 30.0) -> dict[str, Any]:
        """Polls the status until it is so."""
        limit = time.monotonic() + seconds
        while time.monotonic() < limit:
            if ready(found := self.status()):
                return found
            time.sleep(0.005)
        raise SystemExit(f"it did not happen: {found}\n{(self.folder / 'daemon.txt').read_text()}")

    def drive(self) -> None:
        """A controller that turns on the spot, under a made-up certificate; returns when the gate is open."""
        from daemon_rig import made_up_certificate

        controller = self.folder / "turn.py"
        controller.write_text(TURN)
        text = made_up_certificate(
            self.profile, self.folder / "state" / "key.pem", controller, radius=0.5, verified=1.0, epoch=2, weights=WEIGHTS
        )
        answer = self.ask("deploy", path=str(controller), certificate=text)
        if answer["exit_code"]:
            raise SystemExit(f"not deployed: {answer['text']}")
        self.until(lambda s: s["gate"] == "open")

    def log(self) -> Path:
        """The newest log."""
        return max((self.folder / "state" / "logs").glob("*.mcap"), key=lambda path: path.stat().st_mtime_ns)

    def close(self) -> None:
        """Ends the relay."""
        self.relay.close()


# ---------------------------------------------------------------- 2: at 100 Hz


def at_100_hz(seconds: float, layout: str) -> dict[str, Any]:
    """Every pose and command accounted for, and the daemon's share of a core."""
    from bench_daemon import cpu_s

    from s2r_runtime.messages import Observed, Send, SourceStopped
    from s2r_runtime.recording.reading import read

    with tempfile.TemporaryDirectory(prefix="s2r-bench-") as name, contextlib.closing(Bench(Path(name), layout)) as bench:
        with bench.robot() as robot, bench.daemon():
            bench.until(lambda s: s["link"])
            shares: dict[str, float] = {}
            reasons: dict[str, str] = {}

            def measured(what: str) -> None:
                pids = {key: pid for key, pid in bench.status()["pids"].items() if pid}
                before, begin = {key: cpu_s(pid) for key, pid in pids.items()}, time.monotonic()
                time.sleep(seconds / 2)
                after = bench.status()
                for key, pid in pids.items():
                    if after["pids"].get(key) == pid:  # else it ended, and `reason` says why
                        shares[f"{what}_{key}_core"] = (cpu_s(pid) - before[key]) / (time.monotonic() - begin)
                reasons[what] = f"gate {after['gate']}, {after['reason'] or 'no reason'}"

            bench.drive()
            measured("driving")
            bench.ask("undeploy")
            bench.ask("permit", duration_s=36_000.0)
            with ThreadPoolExecutor(1) as pool:
                campaign = pool.submit(bench.ask, "sample", count=5000)
                bench.until(lambda s: s["driving"] == "sampler")
                measured("sampling")
                bench.ask("cancel")
                campaign.result()
            out, _ = robot.communicate("quit\n")
            tally = json.loads(out.splitlines()[-1])
            time.sleep(0.5)
            counters = bench.status()["counters"]
            log = bench.log()
        observed = [m.observation for e in read(log, ["event/observed"]) if isinstance(m := e.message, Observed)]
        sends = sum(isinstance(e.message, Send) for e in read(log, ["out/send"]))
        stopped = [m for e in read(log, ["event/source_stopped"]) if isinstance(m := e.message, SourceStopped) and m.source == "controller"]
    good = [o for o in observed if not o.fault]
    return {
        "layout": layout,
        "seconds": seconds,
        "poses_sent_by_robot": tally["sent"],
        "poses_before_the_link": round((good[0].stamp_ns - 1_700_000_000 * 10**9) / (DT * 1e9)) if good else 0,
        "poses_received": len(observed),
        "poses_dropped_and_counted": counters["dropped_in"],
        "poses_lost_by_their_stamps": counters["lost"],
        "faulty_observations": len(observed) - len(good),
        "commands_decided": sends,
        "commands_dropped_and_counted": counters["dropped_out"],
        "commands_heard_by_robot": tally["commands"],
        "counters": {key: value for key, value in counters.items() if value},
        "at_the_end_of": reasons,
        "controller_stopped": [f"{m.reason} {m.detail}" for m in stopped],
        **shares,
    }


# ---------------------------------------------------------------- 3: cuts


def cuts(number: int, layout: str) -> dict[str, Any]:
    """How long after a cut the gate was closed, and after the link's return the link was up; from the log's own clock."""
    from s2r_runtime.messages import Decided, GateChanged, LinkChanged, Observed
    from s2r_runtime.recording.reading import read

    cut_at: list[int] = []
    back_at: list[int] = []
    with tempfile.TemporaryDirectory(prefix="s2r-bench-") as name, contextlib.closing(Bench(Path(name), layout)) as bench:
        with bench.robot(), bench.daemon():
            bench.until(lambda s: s["link"])
            bench.drive()
            for k in range(number):
                cut_at.append(time.monotonic_ns())
                bench.relay.cut()
                bench.until(lambda s: not s["link"])
                time.sleep(0.05 * (k % 5))
                bench.relay.restore()
                back_at.append(time.monotonic_ns())
                bench.until(lambda s: s["link"])
                bench.until(lambda s: s["gate"] == "open")
        log = bench.log()
        entries = [e.message for e in read(log, ["event/observed", "event/link_changed", "out/gate_changed", "out/decided"])]
    closed, healed, late = [], [], 0
    for n, cut_ns in enumerate(cut_at):
        until_ns = cut_at[n + 1] if n + 1 < number else 2**63
        span = [m for m in entries if cut_ns <= m.t_ns < until_ns]  # type: ignore[union-attr]
        last = max((m.t_ns for m in entries if isinstance(m, Observed) and not m.observation.fault and m.t_ns < back_at[n]), default=cut_ns)
        shut = next(m.t_ns for m in span if isinstance(m, GateChanged) and not m.open)
        late += sum(
            isinstance(m, Decided) and m.allow and m.source == "controller" and m.t_ns > last + 10**9 * (TIMEOUT_S + TICK_S)
            for m in span
            if m.t_ns < back_at[n]
        )
        closed.append((shut - last) * 1e-9)
        healed.append((next(m.t_ns for m in span if isinstance(m, LinkChanged) and m.up and m.t_ns >= back_at[n]) - back_at[n]) * 1e-9)
    return {
        "layout": layout,
        "cuts": number,
        "gate_closed_after_s": {"median": sorted(closed)[number // 2], "max": max(closed), "must_be": CLOSED_S},
        "healed_after_s": {"median": sorted(healed)[number // 2], "max": max(healed), "must_be": 1.0},
        "commands_allowed_too_late": late,
    }


# ---------------------------------------------------------------- all


def main() -> int:
    """Prints the figures; exit 1 if one that must hold does not."""
    parser = argparse.ArgumentParser(description="figures of the ROS 2 transport")
    parser.add_argument("--quick", action="store_true", help="a smoke run")
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--seconds", type=float, default=600.0, help="at 100 Hz (default %(default)s)")
    parser.add_argument("--cuts", type=int, default=100, help="(default %(default)s)")
    parser.add_argument("--layout", choices=("bridge", "rmw"), default="bridge")
    args = parser.parse_args()
    seconds, number = (10.0, 3) if args.quick else (args.seconds, args.cuts)
    found = {
        "decoding": decoding(2000 if args.quick else 20_000),
        "at_100_hz": at_100_hz(seconds, args.layout),
        "cuts": cuts(number, args.layout),
    }
    print(json.dumps(found, indent=None if args.json else 1))
    rate, link = found["at_100_hz"], found["cuts"]
    # Zenoh drops where a link is congested and says so to nobody: such a pose is counted as lost by the stamps
    came = rate["poses_before_the_link"] + rate["poses_received"] + rate["poses_lost_by_their_stamps"]
    unexplained = rate["poses_sent_by_robot"] - came
    wrong = [
        name
        for name, ok in (
            ("poses unexplained", abs(unexplained) <= 1),  # the last one may be on its way
            ("the gate closed late", link["gate_closed_after_s"]["max"] <= CLOSED_S),
            ("a command passed too late", link["commands_allowed_too_late"] == 0),
            ("healed late", link["healed_after_s"]["max"] <= 1.0),
        )
        if not ok
    ]
    for what in wrong:
        print(f"does not hold: {what}", file=sys.stderr)
    return 1 if wrong else 0


if __name__ == "__main__":
    raise SystemExit(main())
