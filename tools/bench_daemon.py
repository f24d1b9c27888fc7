"""The daemon's figures: memory, processor, start, the gate's decision, and what the hop through the daemon adds to a direct one.

    python tools/bench_daemon.py [--quick] [--json]

1. real time at 100 Hz over Zenoh, the sampler driving, then a certified controller: resident memory and share of a core
2. start of the process until its first observation is in its hands, the robot being there already
3. `core.handle` on a recorded drive, by event: what a decision costs in-process
4. lockstep over Zenoh: round trip of an observation and its command, through the daemon (sampler, everything logged) and through a
   process that only answers. Both in one run: their difference is what the hop adds.

Nothing here is a guarantee of time: figures of a busy machine are a busy machine's.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parent.parent
sys.path.insert(0, str(ROOT / "tests" / "rigs"))

DT = 0.01
PROCESSES = ("daemon", "analytics", "controller")
PAGE = os.sysconf("SC_PAGE_SIZE")
TICKS = os.sysconf("SC_CLK_TCK")


# ---------------------------------------------------------------- processes


def resident_mb(pid: int) -> float:
    """Resident set, MB (10^6 bytes)."""
    return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * PAGE / 1e6


def cpu_s(pid: int) -> float:
    """User and system time so far."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / TICKS


class Bench:
    """A folder with a profile, and what runs there."""

    def __init__(self, folder: Path, clock: str, dt: float) -> None:
        self.folder, self.dt, self.clock = folder, dt, clock
        self.ports = free_ports(2)
        text = (ROOT / "profiles" / "robotarium.toml").read_text()
        text = text.replace('clock = "lockstep"', f'clock = "{clock}"').replace("dt = 0.033", f"dt = {dt}")
        text = text.replace("delay = 0.033", f"delay = {dt}").replace("hold_periods = 50", "hold_periods = 20")
        text = text.replace("tcp/127.0.0.1:7461", self.endpoint(0)).replace("tcp/127.0.0.1:7462", self.endpoint(1))
        self.profile = folder / "bench.toml"
        self.profile.write_text(text)
        self.environment = {**os.environ, "XDG_RUNTIME_DIR": str(folder), "XDG_STATE_HOME": str(folder / "home")}

    def endpoint(self, index: int) -> str:
        """Zenoh's name of a free port: 0 toward the robot, 1 toward controllers."""
        return f"tcp/127.0.0.1:{self.ports[index]}"

    @contextmanager
    def robot(self) -> Iterator[subprocess.Popen[bytes]]:
        """The built-in robot as a process."""
        options = ["--realtime"] if self.clock == "realtime" else []
        argv = [sys.executable, "-m", "s2r_standins.robotarium", "--connect", self.endpoint(0), "--period", str(self.dt), *options]
        yield from ended(subprocess.Popen(argv, stdout=subprocess.DEVNULL, stdin=subprocess.DEVNULL))

    @contextmanager
    def daemon(self) -> Iterator[subprocess.Popen[bytes]]:
        """The daemon as a process, its journal in `daemon.txt`."""
        argv = [sys.executable, "-m", "s2r_runtime.cli.main", "run", str(self.profile), "--state", str(self.folder / "state")]
        with (self.folder / "daemon.txt").open("ab") as sink:
            yield from ended(subprocess.Popen(argv, stdout=sink, stderr=sink, env=self.environment))

    def ask(self, verb: str, **fields: Any) -> dict[str, Any]:
        """The daemon's answer to one request, once it listens (30 s at most)."""
        from s2r_runtime.daemon import control

        limit = time.monotonic() + 30.0
        path = self.folder / "s2r" / "robotarium.sock"
        while not control._listening(path) and time.monotonic() < limit:
            time.sleep(0.01)
        return control.call(path, {"verb": verb, **fields})

    def status(self) -> dict[str, Any]:
        """What `s2r status --json` shows."""
        return dict(self.ask("status")["data"])

    def until(self, name: str, value: Any) -> dict[str, Any]:
        """Waits until the status has this value, and gives it whole. Ends the bench after 30 s."""
        limit = time.monotonic() + 30.0
        while time.monotonic() < limit:
            if (found := self.status())[name] == value:
                return found
            time.sleep(0.02)
        raise SystemExit(f"{name} did not become {value}: {(self.folder / 'daemon.txt').read_text()}")

    def logs(self) -> list[Path]:
        """The daemon's logs, the oldest first."""
        return sorted((self.folder / "state" / "logs").glob("*.mcap"))


def ended(process: subprocess.Popen[bytes]) -> Iterator[subprocess.Popen[bytes]]:
    """The process while it is needed."""
    try:
        yield process
    finally:
        process.send_signal(signal.SIGTERM)
        try:
            process.wait(20.0)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


def free_ports(number: int) -> list[int]:
    """Ports that nobody listens on."""
    import socket

    sockets = [socket.socket() for _ in range(number)]
    for one in sockets:
        one.bind(("127.0.0.1", 0))
    ports = [int(one.getsockname()[1]) for one in sockets]
    for one in sockets:
        one.close()
    return ports


# ---------------------------------------------------------------- 1 and 2: at 100 Hz


def at_100_hz(seconds: float) -> dict[str, Any]:
    """Memory and processor while the sampler drives, then while a certified controller does; and the start."""
    from daemon_rig import made_up_certificate

    with tempfile.TemporaryDirectory(prefix="s2r-bench-") as name:
        bench = Bench(Path(name), "realtime", DT)
        with bench.robot():
            time.sleep(1.0)
            began_ns = time.monotonic_ns()
            with bench.daemon():
                bench.until("link", True)
                bench.ask("permit", duration_s=3600.0)
                from concurrent.futures import ThreadPoolExecutor

                with ThreadPoolExecutor(1) as pool:
                    campaign = pool.submit(bench.ask, "sample")
                    bench.until("driving", "sampler")
                    sampling = measured(bench, seconds)
                    bench.ask("cancel")
                    campaign.result()
                controller = bench.folder / "turn.py"
                controller.write_text(
                    "import numpy as np\n\n\ndef control(x, theta, parameters):\n    return np.tile([0.0, 0.5], (len(x), 1))\n"
                )
                # at a radius that this robot stays below; its evidence is made up, as in the tests
                key = bench.folder / "state" / "key.pem"
                text = made_up_certificate(bench.profile, key, controller, radius=0.05, verified=0.1, epoch=2)
                answer = bench.ask("deploy", path=str(controller), certificate=text)
                if answer["exit_code"]:
                    raise SystemExit(f"not deployed: {answer['text']}")
                bench.until("gate", "open")
                drive = measured(bench, seconds)
                latency = bench.status()["controller_latency_ms"]
        first_ns = first_observation_ns(bench.logs()[0])
        return {
            "start_to_first_observation_s": (first_ns - began_ns) * 1e-9,
            "sampling": sampling,
            "driving": drive,
            "controller_latency_ms": latency,
            "decision": decisions(bench.logs()),
        }


def measured(bench: Bench, seconds: float) -> dict[str, float]:
    """Resident memory (MB) and share of a core of the daemon's processes over so many seconds."""
    pids = {name: pid for name, pid in bench.status()["pids"].items() if pid}
    before, begin, seen = {name: cpu_s(pid) for name, pid in pids.items()}, time.monotonic(), bench.status()["counters"]["received"]
    time.sleep(seconds)
    elapsed = time.monotonic() - begin
    rate = (bench.status()["counters"]["received"] - seen) / elapsed
    found = {"observations_per_s": rate}
    for name, pid in pids.items():
        found[f"{name}_mb"], found[f"{name}_core"] = resident_mb(pid), (cpu_s(pid) - before[name]) / elapsed
    found["together_mb"] = found["daemon_mb"] + found["analytics_mb"]
    found["together_core"] = found["daemon_core"] + found["analytics_core"]
    return found


def first_observation_ns(log: Path) -> int:
    """When the first frame was in the daemon's hands (host's monotonic clock)."""
    from s2r_runtime.messages import Frame
    from s2r_runtime.recording.reading import read

    for entry in read(log, ["frame/in"]):
        if isinstance(entry.message, Frame):
            return entry.message.arrival_ns
    raise SystemExit(f"{log}: no observation")


# ---------------------------------------------------------------- 3: the decision in-process


def decisions(logs: list[Path]) -> dict[str, dict[str, float]]:
    """Time of `core.handle`, µs, by event; `proposed` holds the gate's decision and the command."""
    from s2r_runtime.core import reducer as core
    from s2r_runtime.recording.reading import read

    events = [entry.message for log in logs for entry in read(log) if entry.channel.startswith("event/")]
    times: dict[str, list[float]] = {}
    for _ in range(3):
        state = core.initial()
        for event in events:
            begin = time.perf_counter_ns()
            state, _ = core.handle(state, event)  # type: ignore[arg-type]
            times.setdefault(type(event).__name__.lower(), []).append((time.perf_counter_ns() - begin) * 1e-3)
    return {name: percentiles(values) for name, values in times.items() if name in {"observed", "proposed", "measured", "ticked"}}


def percentiles(values: list[float]) -> dict[str, float]:
    """Median, p99, largest and number."""
    ordered = sorted(values)
    return {"p50": statistics.median(ordered), "p99": ordered[int(0.99 * (len(ordered) - 1))], "max": ordered[-1], "n": float(len(ordered))}


# ---------------------------------------------------------------- 4: the hop


def hop(steps: int) -> dict[str, Any]:
    """Round trips in µs, alternating: direct, through the daemon, direct, through the daemon."""
    direct: list[float] = []
    through: list[float] = []
    throughput = 0.0
    for _ in range(2):
        direct += direct_round_trips(steps // 2)
        found, rate = daemon_round_trips(steps // 2)
        through += found
        throughput = max(throughput, rate)
    a, b = percentiles(direct), percentiles(through)
    return {"direct_us": a, "daemon_us": b, "added_us": {name: b[name] - a[name] for name in ("p50", "p99")}, "steps_per_s": throughput}


class Prober:
    """A robot in lockstep that notes how long each answer took. Its body is the built-in robot's."""

    def __init__(self, connect: str) -> None:
        from s2r_standins.body import Body, DataSheet
        from s2r_standins.link import Link

        self.body = Body(DataSheet(), (0.0, 0.0, 0.0), 1)
        self.link = Link("s2r/robot", ("v", "w"), connect=connect, boot=time.time_ns() % 2**53)

    def run(self, steps: int, skip: int) -> list[float]:
        """Round trips, µs, after the first `skip`."""
        found: list[float] = []
        with self.link:
            while len(found) < steps + skip:
                x, y, theta = self.body.observe()
                stamp_ns = round(self.body.k * self.body.sheet.dt * 1e9)
                data = self.link.encode(self.body.k, stamp_ns, {"x": x, "y": y, "theta": theta})
                begin = time.perf_counter_ns()
                self.link.publish(data)
                answer = None
                while answer is None or answer.obs_seq != self.body.k:
                    if not self.link.poller.poll(100.0):
                        self.link.publish(data)
                        begin = time.perf_counter_ns()  # it waited for a source, or a datagram was lost: no round trip
                    answer = self.link.latest() or answer
                found.append((time.perf_counter_ns() - begin) * 1e-3)
                self.body.move((answer.input["v"], answer.input["w"]))
        return found[skip:]


def direct_round_trips(steps: int) -> list[float]:
    """Through a process that answers every observation with a zero command and does nothing else."""
    endpoint = f"tcp/127.0.0.1:{free_ports(1)[0]}"
    for process in ended(subprocess.Popen([sys.executable, __file__, "--answer", endpoint])):
        assert process.poll() is None
        return Prober(endpoint).run(steps, 200)
    return []


def daemon_round_trips(steps: int) -> tuple[list[float], float]:
    """Through the daemon while its sampler drives; and control steps per second."""
    from concurrent.futures import ThreadPoolExecutor

    with tempfile.TemporaryDirectory(prefix="s2r-bench-") as name:
        bench = Bench(Path(name), "lockstep", 0.033)
        with bench.daemon(), ThreadPoolExecutor(1) as pool:
            trips = pool.submit(Prober(bench.endpoint(0)).run, steps, 200)
            bench.until("link", True)
            bench.ask("permit", duration_s=36000.0)
            with ThreadPoolExecutor(1) as campaigns:
                campaign = campaigns.submit(bench.ask, "sample", count=5000)
                begin = time.monotonic()
                found = trips.result()
                rate = steps / (time.monotonic() - begin)
                bench.ask("cancel")
                campaign.result()
    return found, rate


def answer(endpoint: str) -> int:
    """The direct peer: a command for every observation, from the thread that got it."""
    import msgspec
    import zenoh
    from s2r_zenoh.testing import session

    decode, encode = msgspec.json.Decoder(dict[str, Any]).decode, msgspec.json.Encoder().encode
    with session("peer", listen=endpoint) as opened:
        commands = opened.declare_publisher("s2r/robot/command", congestion_control=zenoh.CongestionControl.DROP, express=True)

        def take(sample: zenoh.Sample) -> None:
            seen = decode(sample.payload.to_bytes())
            t_ns, seq = time.monotonic_ns(), seen["seq"]
            command = {"seq": seq, "t_ns": t_ns, "obs_seq": seq, "ttl_ns": 10**9, "source": "", "input": {"v": 0.0, "w": 0.1}}
            commands.put(encode(command))

        opened.declare_subscriber("s2r/robot/observation", zenoh.handlers.Callback(take, indirect=False))
        signal.pause()
    return 0


# ---------------------------------------------------------------- the table


def main() -> int:
    """Exit 0 once all was measured; what is above its target is marked."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="a smoke run")
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--answer", metavar="ENDPOINT", help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.answer:
        signal.signal(signal.SIGTERM, lambda *_: os._exit(0))
        return answer(args.answer)
    found = {"at_100_hz": at_100_hz(3.0 if args.quick else 15.0), "hop": hop(1000 if args.quick else 6000)}
    if args.json:
        print(json.dumps(found))
        return 0
    report(found)
    return 0


def report(found: dict[str, Any]) -> None:
    """Figures beside their targets."""
    live, trip = found["at_100_hz"], found["hop"]
    for name in ("sampling", "driving"):
        m = live[name]
        print(f"{name} at {m['observations_per_s']:.0f} Hz")
        line("daemon + analytics, resident", m["together_mb"], 100.0, "MB")
        line("daemon + analytics, processor", 100.0 * m["together_core"], 10.0, "% of a core")
        each = (f"{one} {m[f'{one}_mb']:.0f} MB {100.0 * m[f'{one}_core']:.1f} %" for one in PROCESSES if f"{one}_mb" in m)
        print(f"    {', '.join(each)}")
    line("start to first observation", live["start_to_first_observation_s"], 1.0, "s")
    for name, times in live["decision"].items():
        line(f"core.handle({name}), p99", times["p99"], 100.0 if name == "proposed" else None, f"µs (median {times['p50']:.0f})")
    print(f"round trip over Zenoh: direct {trip['direct_us']['p50']:.0f} µs, through the daemon {trip['daemon_us']['p50']:.0f} µs (median)")
    print(f"the hop adds {trip['added_us']['p50']:.0f} µs at the median, {trip['added_us']['p99']:.0f} µs at p99")
    line("lockstep, everything logged", trip["steps_per_s"], 1200.0, "control steps/s", at_least=True)


def line(what: str, value: float, target: float | None, unit: str, *, at_least: bool = False) -> None:
    """One figure."""
    good = target is None or (value >= target if at_least else value <= target)
    wanted = (
        ""
        if target is None
        else f"  ({'at least' if at_least else 'at most'} {target:g}){'' if good else '  ABOVE' if not at_least else '  BELOW'}"
    )
    print(f"  {what:32s} {value:9.2f} {unit}{wanted}")


if __name__ == "__main__":
    raise SystemExit(main())
