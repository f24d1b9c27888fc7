"""The daemon for half an hour at 100 Hz and at 1 kHz: does its memory grow, does its latency, and how steady are its commands.

    python tools/bench_endurance.py [--minutes 30] [--rate 100|1000]... [--fifo PRIORITY] [--quick] [--json]

A certified controller drives the built-in robot's body over Zenoh in real time. The robot's end is this process: it publishes an
observation every period on its own clock, and notes when the command came that answers it. Its own lateness (of a process that a busy
machine holds up) is counted apart: an observation that it published late, by more than a tenth of a period and 0.5 ms, says nothing
of the daemon.

    latency     from publishing an observation until the command that answers it is in the robot's hands, ms
    unanswered  observations to which no command came before the next but nine
    jitter      of the intervals between commands: the median and 99 % of |interval - period|, ms
    growth      of what is resident, in MB an hour: the slope (Theil-Sen) over the second half; the first fills caches
    drift       median latency of the last sixth less that of the second sixth (the first warms up), ms

Flat means: the slope tells no more than --flat MB an hour, and the drift no more than a tenth of a period (or 0.5 ms). A shared machine's
figures are a shared machine's: `load` stands beside them.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import select
import statistics
import sys
import tempfile
import threading
import time
from array import array
from pathlib import Path
from typing import Any

from bench_daemon import Bench, cpu_s, percentiles, resident_mb

ROOT = Path(__file__).parent.parent
sys.path.insert(0, str(ROOT / "tests" / "rigs"))

ANSWERED_WITHIN = 10
"""Periods after which an observation counts as unanswered."""
PUNCTUAL_NS = 500_000
"""What a kernel that is no real-time one, and an interpreter, need to wake up; above 200 Hz it is more than a tenth of a period."""
LOOK_S = 5.0
"""Between two looks at memory and counters."""
PATIENT = """
[gate]
controller_deadline = 2.0
observation_timeout = 1.0
command_ttl = 1.0
"""
"""What is measured is how late things come, not what becomes of them: with the profile's 50 ms, one turn of a busy machine ends the run."""
FLAT_MB_PER_HOUR = 8.0
"""A leak of one page an observation at 100 Hz would be 1500 MB an hour; allocators breathe by a few."""


class Robot(threading.Thread):
    """The robot's end: real time, one observation a period."""

    def __init__(self, endpoint: str, dt: float) -> None:
        super().__init__(daemon=True)
        from s2r_standins.body import Body, DataSheet
        from s2r_standins.link import Link

        self.dt, self.over = dt, threading.Event()
        self._body = Body(DataSheet(dt=dt), (0.0, 0.0, 0.0), 1)
        self._link = Link("s2r/robot", ("v", "w"), connect=endpoint, boot=time.time_ns() % 2**53)
        self.noting = threading.Event()
        self.published = self.late = self.answered = 0
        self.latency_ms, self.interval_ms = array("f"), array("f")

    def run(self) -> None:
        """Until `over`."""
        sent: dict[int, tuple[int, bool]] = {}
        command, valid_until, before_ns = (0.0, 0.0), 0.0, 0
        due_ns = time.monotonic_ns()
        with self._link as link:
            while not self.over.is_set():
                k, now_ns = self._body.k, time.monotonic_ns()
                x, y, theta = self._body.observe()
                data = link.encode(k, round(k * self.dt * 1e9), {"x": x, "y": y, "theta": theta})
                punctual = now_ns - due_ns < max(0.1 * self.dt * 1e9, PUNCTUAL_NS)
                sent[k] = time.monotonic_ns(), punctual
                sent.pop(k - ANSWERED_WITHIN, None)
                link.publish(data)
                if self.noting.is_set():
                    self.published += 1
                    self.late += not punctual
                due_ns += round(self.dt * 1e9)
                if now_ns - due_ns > 1e9:  # it was held up for long: its clock goes on from here
                    due_ns = now_ns
                while (left_s := (due_ns - time.monotonic_ns()) * 1e-9) > 0.0:
                    if not select.select([link.fileno], [], [], left_s)[0]:
                        continue
                    if (answer := link.latest()) is None:
                        continue
                    came_ns = time.monotonic_ns()
                    command, valid_until = (answer.input["v"], answer.input["w"]), self._body.now_s + answer.ttl_ns * 1e-9
                    asked_ns, counts = sent.pop(answer.obs_seq, (0, False))
                    if self.noting.is_set() and asked_ns and counts:
                        self.answered += 1
                        self.latency_ms.append((came_ns - asked_ns) * 1e-6)
                        if before_ns:
                            self.interval_ms.append((came_ns - before_ns) * 1e-6)
                    before_ns = came_ns if counts else 0
                self._body.move(command if self._body.now_s < valid_until else (0.0, 0.0))


def endure(rate: float, minutes: float, fifo: int) -> dict[str, Any]:
    """One run. fifo: real-time priority of the daemon, its controller and the robot's end; 0: none."""
    from daemon_rig import made_up_certificate

    dt = 1.0 / rate
    with tempfile.TemporaryDirectory(prefix="s2r-endurance-") as name:
        bench = Bench(Path(name), "realtime", dt)
        bench.profile.write_text(bench.profile.read_text() + PATIENT)
        robot = Robot(bench.endpoint(0), dt)
        robot.start()
        try:
            with bench.daemon() as daemon:
                bench.until("link", True)
                controller = bench.folder / "turn.py"
                controller.write_text(
                    "import numpy as np\n\n\ndef control(x, theta, parameters):\n    return np.tile([0.0, 0.5], (len(x), 1))\n"
                )
                key = bench.folder / "state" / "key.pem"
                text = made_up_certificate(bench.profile, key, controller, radius=0.5, verified=1.0, epoch=1)
                answer = bench.ask("deploy", path=str(controller), certificate=text)
                if answer["exit_code"]:
                    raise SystemExit(f"not deployed: {answer['text']}")
                try:
                    bench.until("gate", "open")
                except SystemExit:
                    raise SystemExit(f"the gate does not open: {bench.status()['reason']}; {ends(bench)}") from None
                if fifo:  # as if the service manager had given it: each helper stands back from the daemon
                    pids = bench.status()["pids"]
                    for pid, below in ((os.getpid(), 0), (daemon.pid, 0), (pids["controller"], 1), (pids["analytics"], 2)):
                        hurry(pid, max(1, fifo - below))
                robot.noting.set()
                found = watched(bench, minutes * 60.0)
                robot.noting.clear()
                counters = bench.status()["counters"]
        finally:
            robot.over.set()
            robot.join(5.0)
        log_mb = sum(log.stat().st_size for log in bench.logs()) / 1e6
    return {"rate_hz": rate, "minutes": minutes, "log_mb": log_mb, "counters": counters} | found | steadiness(robot)


def hurry(pid: int, priority: int) -> None:
    """All threads of a process: first in, first out, before everything that is not real time."""
    for thread in Path(f"/proc/{pid}/task").iterdir():
        os.sched_setscheduler(int(thread.name), os.SCHED_FIFO, os.sched_param(priority))


def watched(bench: Bench, seconds: float) -> dict[str, Any]:
    """What is resident, every few seconds, and how often the gate was seen closed."""
    pids = {name: pid for name, pid in bench.status()["pids"].items() if pid}
    before, begin = {name: cpu_s(pid) for name, pid in pids.items()}, time.monotonic()
    t, resident = [], {name: [] for name in pids}  # type: ignore[var-annotated]
    reasons: dict[str, int] = {}
    load, restarts = [], 0
    while (now := time.monotonic() - begin) < seconds:
        status = bench.status()
        if status["gate"] != "open":
            reasons[status["reason"]] = reasons.get(status["reason"], 0) + 1
        if status["pids"]["controller"] != pids["controller"]:
            why = status["reason"], status["revoked"], status["latched"]
            raise SystemExit(f"after {now:.0f} s the controller's process ended: {why}, {ends(bench)}")
        if (again := status["pids"]["analytics"]) != pids["analytics"]:
            if not again or not Path(f"/proc/{again}/stat").exists():
                time.sleep(1.0)
                continue
            restarts += 1
            pids["analytics"], before["analytics"] = again, cpu_s(again)
        t.append(now / 3600.0)
        for name, pid in pids.items():
            resident[name].append(resident_mb(pid))
        load.append(os.getloadavg()[0])
        time.sleep(min(LOOK_S, max(0.05, seconds - now)))
    elapsed = time.monotonic() - begin
    half = len(t) // 2
    return {
        "looks": len(t),
        "closed_when_looked": reasons,
        "analytics_restarts": restarts,
        "load": statistics.median(load),
        "processes": {
            name: {
                "mb_begin": values[0],
                "mb_half": values[half],
                "mb_end": values[-1],
                "mb_per_hour": slope(t[half:], values[half:]),
                "core": (cpu_s(pids[name]) - before[name]) / elapsed if Path(f"/proc/{pids[name]}").exists() else math.nan,
            }
            for name, values in resident.items()
        },
    }


def ends(bench: Bench) -> list[str]:
    """What the log says of sources and processes that ended."""
    from s2r_runtime.recording.reading import read

    kinds = ("event/analytics_changed", "event/source_stopped", "event/recorder_changed", "event/link_changed")
    return [str(entry.message) for log in bench.logs() for entry in read(log, kinds)]


def slope(t: list[float], values: list[float]) -> float:
    """Theil-Sen: the median of the slopes between all pairs (of at most 300 points)."""
    every = max(1, len(t) // 300)
    points = list(zip(t[::every], values[::every], strict=True))
    slopes = [(b - a) / (s - r) for i, (r, a) in enumerate(points) for s, b in points[i + 1 :]]
    return statistics.median(slopes) if slopes else 0.0


def steadiness(robot: Robot) -> dict[str, Any]:
    """Latency and intervals of the commands that reached the robot."""
    latency, period_ms = list(robot.latency_ms), robot.dt * 1e3
    sixth = max(1, len(latency) // 6)
    off = [abs(interval - period_ms) for interval in robot.interval_ms]
    return {
        "published": robot.published,
        "published_late": robot.late,
        "commands_per_s": len(latency) / (robot.published * robot.dt),
        "unanswered": robot.published - robot.late - robot.answered,
        "latency_ms": percentiles(latency) | {"p999": sorted(latency)[int(0.999 * (len(latency) - 1))]},
        "jitter_ms": percentiles(off),
        "drift_ms": statistics.median(latency[-sixth:]) - statistics.median(latency[sixth : 2 * sixth] or latency),
    }


def report(found: dict[str, Any], flat_mb: float) -> list[str]:
    """Prints it; returns what is not flat."""
    latency, jitter = found["latency_ms"], found["jitter_ms"]
    print(f"{found['rate_hz']:g} Hz for {found['minutes']:g} minutes (load average {found['load']:.1f} on {os.cpu_count()} cores)")
    print(
        f"  latency    median {latency['p50']:.2f} ms, 99 % {latency['p99']:.2f}, 99.9 % {latency['p999']:.2f}, most {latency['max']:.1f}; "
        f"drift {found['drift_ms']:+.3f} ms"
    )
    print(f"  jitter     median {jitter['p50']:.2f} ms, 99 % {jitter['p99']:.2f}")
    print(
        f"  commands   {found['published']} observations, {found['published_late']} of them late on the robot's side, "
        f"{found['unanswered']} of the others unanswered; log {found['log_mb']:.0f} MB"
    )
    for name, p in found["processes"].items():
        print(
            f"  {name:10s} {p['mb_begin']:.1f} MB at the beginning, {p['mb_half']:.1f} half way, {p['mb_end']:.1f} at the end; "
            f"{p['mb_per_hour']:+.1f} MB an hour; {100 * p['core']:.1f} % of a core"
        )
    if found["analytics_restarts"]:
        print(f"  analytics was {found['analytics_restarts']} times too slow, and started anew")
    if found["closed_when_looked"]:
        print(f"  gate seen closed: {found['closed_when_looked']} of {found['looks']} looks")
    growing = [f"{name} grows by {p['mb_per_hour']:.1f} MB an hour" for name, p in found["processes"].items() if p["mb_per_hour"] > flat_mb]
    if found["drift_ms"] > max(100.0 / found["rate_hz"], PUNCTUAL_NS * 1e-6):
        growing.append(f"latency grew by {found['drift_ms']:.3f} ms")
    for line in growing:
        print(f"  NOT FLAT: {line}")
    return growing


def main() -> int:
    """Exit 1 if something grows."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=30.0, help="of driving, each rate (default 30)")
    parser.add_argument("--rate", type=float, action="append", help="Hz; may be repeated (default: 100 and 1000)")
    parser.add_argument("--fifo", type=int, default=0, metavar="PRIORITY", help="real-time priority, 1 to 99 (takes the right to it)")
    parser.add_argument("--flat", type=float, default=FLAT_MB_PER_HOUR, metavar="MB", help="growth an hour that counts as none")
    parser.add_argument("--quick", action="store_true", help="a smoke run of 20 s each, in which growth is not judged")
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args()
    growing = []
    for rate in args.rate or (100.0, 1000.0):
        found = endure(rate, 1.0 / 3.0 if args.quick else args.minutes, args.fifo)
        if args.json:
            print(json.dumps(found), flush=True)
        growing += report(found, 1e9 if args.quick else args.flat) if not args.json else []
    return 1 if growing else 0


if __name__ == "__main__":
    raise SystemExit(main())
