"""The demo's story. Each step is a request that a person could type; what comes back decides how the story goes on.

It is honest about its robot: if no effect is switched on, nothing is refused; if the tracer cannot name the effect, the
robot stays parked; and the run ends with the audit of its own log.
"""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any

from s2r_runtime.cli import output
from s2r_runtime.cli.supervised import EndedBySignal
from s2r_runtime.daemon import control
from s2r_runtime.errors import ConfigError, S2RError, UsageError
from s2r_runtime.evidence.whiteness import SERIAL_ALPHA
from s2r_runtime.hookspecs import Story
from s2r_runtime.messages import SERIAL
from s2r_runtime.plugins import registry

START_S, STOP_S, CAMPAIGN_S = 90.0, 60.0, 900.0
"""A process that ended is noticed at once; one that loads its libraries on a busy computer is waited for."""
DRIVES = 8
"""So often the controller is let drive, at most: mostly the radius has grown meanwhile, so that it soon fails."""

EVIDENCE = ("rollouts score below", "progress requirement does not hold", "the radius grew to", "the gap has grown to", "was refuted")
"""Of refusals: what was measured, or what verification showed, and not that something failed."""


class Demonstration:
    """One run of the demo. Its folder holds everything: profile, state, log, models, report."""

    def __init__(self, robot: str, out: Path | None, seed: int, effects: list[str] | None, change: str | None) -> None:
        self._robot = registry().get("robots", robot)
        self._name = robot
        self._seed = seed
        self._story: Story = self._robot.story
        self._effects = [e for e in (self._story.effects if effects is None else effects) if e != "none"]
        self._change = None if change == "none" else change or self._story.change
        self._robot.command(seed, self._effects)  # says at once if something is not installed
        if change not in (None, "none"):
            self._check(str(change))
        self._out = _fresh(out)
        self._begin = time.monotonic()
        self._socket = Path()
        self._hold_gap = 0.0

    def run(self) -> int:
        """The story; exit code of the verb."""
        ports = _free_ports(2)
        profile = self._write_profile(ports)
        with ExitStack() as stack:
            stack.enter_context(_unwound_by(signal.SIGTERM, signal.SIGHUP))
            robot = stack.enter_context(self._robot_process(ports))
            daemon = stack.enter_context(self._daemon(profile))
            held = self._loop(robot, profile)
            self._end_daemon(daemon)
        return self._afterwards(held)

    def _check(self, change: str) -> None:
        """Raises ConfigError where the robot, begun with it and ended at once, has no such effect: later it would tell nobody."""
        argv = self._robot.command(self._seed, [change], connect=f"tcp/127.0.0.1:{_free_ports(1)[0]}")
        with suppress(subprocess.TimeoutExpired):  # it has begun
            done = subprocess.run(argv, input="quit\n", capture_output=True, text=True, timeout=START_S, check=False)
            if done.returncode == ConfigError.exit_code and (said := done.stderr.strip()):
                raise ConfigError(f"--change: {said.splitlines()[-1]}")

    # ------------------------------------------------------------------ the story

    def _loop(self, robot: subprocess.Popen[str], profile: Path) -> bool:
        """Up to the last refusal. True if what was expected of the runtime happened."""
        controller = self._robot.controller("good")
        fault = ", ".join(self._effects) or "none"
        self._headline(f"simulated robot {self._name!r} in its own process; injected fault: {fault} (hidden from the daemon)")
        self._await_robot(robot)
        if not self._campaign():
            return False
        self._step(f"s2r deploy {controller.name}", "certify the controller against this gap, else it may not drive")
        if self._ask({"verb": "deploy", "path": str(controller), "parameters": {}})["exit_code"] == 0:
            self._say("certified without a repair of the model", "green")
            return self._drive(robot, controller, running=True)
        if not self._repair():
            self._say("no effect was identified with confidence: the model stays as it is, and the robot stays parked", "yellow")
            return True
        return self._campaign() and self._drive(robot, controller, running=False)

    def _campaign(self) -> bool:
        command = f"s2r permit {self._story.permit_s:.0f} && s2r sample"
        self._step(command, "measure the gap between robot and model, at random states and inputs")
        answer = self._sample()
        if answer["exit_code"] != 0 and SERIAL in str(answer["text"]):
            one_in = round(1.0 / SERIAL_ALPHA)
            self._say(f"at most 1 in {one_in} campaigns of independent samples fails this test; two in a row indicate a drift")
            self._step(command, "repeat, with the next share of the error budget beta")
            answer = self._sample()
        gap = answer.get("data") or {}
        if gap and answer["exit_code"] == 0:
            hold, before = gap["hold_radius"], self._hold_gap
            self._say(
                f"model error after one step {1e3 * gap['radius']:.3g} mm, after {gap['hold_periods']} steps {1e3 * hold:.3g} mm"
                + (f" (before the repair {1e3 * before:.3g} mm)" if before else "")
            )
            self._hold_gap = hold
        return bool(answer["exit_code"] == 0)

    def _sample(self) -> dict[str, Any]:
        """One campaign, with a permit of its own: it lasts for one."""
        permitted = self._call({"verb": "permit", "duration_s": self._story.permit_s})
        if permitted["exit_code"] != 0:
            self._report(permitted)
        return self._ask({"verb": "sample", "count": 0})

    def _repair(self) -> bool:
        self._step("s2r trace --live campaign", "find the effect that the model lacks")
        answer = self._ask({"verb": "trace", "text": "campaign"})
        data = answer.get("data") or {}
        headline, *others = str(data.get("text", "")).split("\n\n")
        for part in (headline, *(one for one in others if one.startswith("error"))):
            self._say(part)
        if answer["exit_code"] != 0 or data.get("verdict") not in {"traced", "ambiguous"} or not data.get("effects"):
            return False
        if data["proposal"]["proposed"]:
            self._step("s2r adopt", "use the repaired model; the old gap does not apply to it")
            return bool(self._ask({"verb": "adopt"})["exit_code"] == 0)
        model = Path(str(data["model_path"]))
        self._step(f"s2r adopt {model.name}", "use the repaired model; the old gap does not apply to it")
        text = model.read_text(encoding="utf-8")
        return bool(self._ask({"verb": "adopt", "text": text, "base": str(model.parent)})["exit_code"] == 0)

    def _drive(self, robot: subprocess.Popen[str], controller: Path, *, running: bool) -> bool:
        if self._change:
            seconds = self._story.change_after_s
            self._say(f"(hidden fault at t = {seconds:.0f} s of simulated time: {self._change})", "dim")
            self._to_robot(robot, f"effect {self._change} @+{seconds}")
        if not running:
            self._step(f"s2r deploy {controller.name}", "certify it at the smaller gap, then drive")
            answer = self._ask({"verb": "deploy", "path": str(controller), "parameters": {}})
            if answer["exit_code"] != 0 and not _by_evidence(answer):
                return self._otherwise("the refusal has another reason than its behaviour on the model")
            if answer["exit_code"] != 0:
                self._say("still refused: with the remaining gap this controller is not safe enough on the repaired model", "yellow")
                return True
        return self._watch_it(robot)

    def _watch_it(self, robot: subprocess.Popen[str]) -> bool:
        """Watches it drive, and asks for it again where its certificate was revoked, or where it failed, until that is refused. True if
        evidence has stopped it for good, or its scenarios are done.

        A verification at the grown radius is a fresh draw: where the controller passes only just, a second one may pass. Then it drives
        under a certificate that covers what was seen so far, until the stream shows more.
        """
        limit = time.monotonic() + CAMPAIGN_S
        for drive in range(1, DRIVES + 1):
            status = self._follow(robot, limit)
            self._show(status)
            latched = status.get("latched") or []
            if status.get("controller") or status.get("job"):
                return self._otherwise("the robot's process has ended" if robot.poll() is not None else f"{CAMPAIGN_S:.0f} s are over")
            if status.get("gate") != "closed" or latched not in ([], ["controller_fault"], ["watch_alarm"]):
                return self._otherwise("the gate closed for another reason than the gap")
            if status.get("reason") == "no_controller" or latched == ["watch_alarm"]:
                return self._stopped()
            if drive == DRIVES:
                break
            if latched:
                self._step("s2r clear controller_fault", "the controller failed; on a busy machine its answer may miss the deadline")
                self._ask({"verb": "clear", "text": "controller_fault"})
            self._step("s2r deploy", "try again at the gap that it was stopped for")
            answer = self._ask({"verb": "deploy", "path": str(self._robot.controller("good")), "parameters": {}})
            if answer["exit_code"] != 0:
                return (
                    self._stopped()
                    if _by_evidence(answer)
                    else self._otherwise("the refusal has another reason than its behaviour on the model")
                )
        return self._otherwise(f"it was stopped {DRIVES} times")

    def _stopped(self) -> bool:
        self._say("the gate is closed; the fallback controller has stopped the robot", "green")
        return True

    def _otherwise(self, how: str) -> bool:
        """Reports an end that the demo did not expect; False."""
        self._say(f"unexpected end: {how}", "red")
        return False

    def _follow(self, robot: subprocess.Popen[str], limit: float) -> dict[str, Any]:
        """The status when nothing drives any more, or the robot is gone, or time is up. limit: s, of `time.monotonic`."""
        shown = 0
        while True:
            status = dict(self._call({"verb": "status"}).get("data") or {})
            for episode in status.get("episodes", [])[shown:]:
                self._say(f"scenario {episode['index']}: safety value {episode['safety']:+.2f} m after {episode['steps']} steps")
                shown += 1
            over = time.monotonic() > limit or robot.poll() is not None
            if over or (not status.get("controller") and not status.get("job")):
                return status
            time.sleep(0.05)

    def _show(self, status: dict[str, Any]) -> None:
        self._step("s2r status", "")
        for key in ("gate", "reason", "radius", "latched"):
            if (value := status.get(key)) not in (None, [], {}, ""):
                self._say(f"{key}: {value:.3g}" if isinstance(value, float) else f"{key}: {value}")

    def _afterwards(self, held: bool) -> int:
        log, public = sorted((self._out / "logs").glob("*.mcap")), self._out / "state" / "key.pub"
        names = " ".join(str(path) for path in log)
        self._step(f"s2r audit {names} --key {public} --rerun-controllers", "recompute every decision from the log alone")
        audited, lines = _s2r("audit", *map(str, log), "--key", str(public), "--rerun-controllers")
        for line in lines if audited else (one for one in lines if one.startswith(("holds", "certificate"))):
            self._say(line)
        report = self._out / "report.html"
        reported, lines = _s2r("report", *map(str, log), "-o", str(report))
        for line in lines if reported else ():
            self._say(line)
        seconds = time.monotonic() - self._begin
        output.out()
        output.out(f"{'done' if held and not audited else 'demo FAILED'} after {seconds:.0f} s.  log: {names}  report: {report}")
        output.out(
            f"next: open {report};  s2r log info {log[-1] if log else ''};  s2r demo --effect none;  docs/robot-owner.md for your own robot"
        )
        return 0 if held and audited == 0 and reported == 0 else 1

    # ------------------------------------------------------------------ processes

    def _write_profile(self, ports: list[int]) -> Path:
        text = str(self._robot.profile_text(f"tcp/127.0.0.1:{ports[0]}", f"tcp/127.0.0.1:{ports[1]}"))
        path = self._out / f"{self._name}.toml"
        path.write_text(text, encoding="utf-8")
        return path

    @contextmanager
    def _robot_process(self, ports: list[int]) -> Iterator[subprocess.Popen[str]]:
        argv = self._robot.command(self._seed, self._effects, connect=f"tcp/127.0.0.1:{ports[0]}")
        with (self._out / "robot.txt").open("w", encoding="utf-8") as sink:
            process = subprocess.Popen(argv, stdin=subprocess.PIPE, stdout=sink, stderr=sink, text=True)
            try:
                yield process
            finally:
                _end(process)

    @contextmanager
    def _daemon(self, profile: Path) -> Iterator[subprocess.Popen[str]]:
        state = self._out / "state"
        argv = [
            sys.executable,
            "-m",
            "s2r_runtime.cli.simulated_daemon",
            str(profile),
            "--state",
            str(state),
            "--log",
            str(self._out / "logs"),
            "--seed",
            str(self._seed),
        ]
        with (self._out / "daemon.txt").open("w", encoding="utf-8") as sink:
            environment = {**os.environ, "XDG_RUNTIME_DIR": str(_private(self._out / "run"))}
            process = subprocess.Popen(argv, stdout=sink, stderr=sink, text=True, env=environment)
            try:
                self._socket = self._await_socket(process)
                yield process
            finally:
                _end(process)

    def _await_socket(self, process: subprocess.Popen[str]) -> Path:
        limit = time.monotonic() + START_S
        while time.monotonic() < limit:
            if (found := list((self._out / "run").rglob("*.sock"))) and _answers(found[0]):
                return found[0]
            if process.poll() is not None:
                break
            time.sleep(0.02)
        raise S2RError(f"the daemon did not start: {(self._out / 'daemon.txt').read_text(encoding='utf-8').strip()[-300:]}")

    def _await_robot(self, robot: subprocess.Popen[str]) -> None:
        limit = time.monotonic() + START_S
        while time.monotonic() < limit and robot.poll() is None:
            status = self._call({"verb": "status"})["data"]
            if status["link"] and status["observation"]:
                return
            time.sleep(0.02)
        said = (self._out / "robot.txt").read_text(encoding="utf-8").strip()
        if robot.poll() == ConfigError.exit_code and said:  # it says itself what was wrong with what it was given
            raise ConfigError(said.splitlines()[-1])
        raise S2RError(f"no observations from the robot: {said[-300:]}")

    def _end_daemon(self, process: subprocess.Popen[str]) -> None:
        process.terminate()
        try:
            process.wait(STOP_S)
        except subprocess.TimeoutExpired:
            self._say("the daemon did not end on SIGTERM", "red")

    def _to_robot(self, robot: subprocess.Popen[str], line: str) -> None:
        if robot.stdin is not None:
            robot.stdin.write(line + "\n")
            robot.stdin.flush()
            time.sleep(0.3)  # its time stands still while nobody commands it, so the moment does not depend on this

    # ------------------------------------------------------------------ words

    def _ask(self, request: dict[str, Any]) -> dict[str, Any]:
        answer = self._call(request)
        self._report(answer)
        return answer

    def _report(self, answer: dict[str, Any]) -> None:
        code = answer["exit_code"]
        self._say(str(answer["text"]) + (f" (exit code {code})" if code else ""), "red" if code else "green")

    def _call(self, request: dict[str, Any]) -> dict[str, Any]:
        bar = output.Progress("   " + str(request["verb"]))

        def on_progress(line: dict[str, Any]) -> None:
            if "total" in line:
                bar(float(line["done"]), float(line["total"]), str(line.get("detail", "")), line.get("seconds_left"))
            elif line.get("text"):
                bar.close()
                self._say(str(line["text"]), "dim")

        try:
            return control.call(self._socket, request, on_progress)
        finally:
            bar.close()

    def _step(self, command: str, why: str) -> None:
        output.out()
        output.out(output.styled(f"$ {command}", "bold") + (f"   # {why}" if why else ""))
        output.flush()

    def _headline(self, text: str) -> None:
        output.out(text)
        output.flush()

    def _say(self, text: str, style: str = "") -> None:
        for line in text.split("\n"):
            output.out("   " + (output.styled(line, style) if style else line))
        output.flush()


def _by_evidence(answer: dict[str, Any]) -> bool:
    """Whether a refusal is for what the controller does on the model, at the gap that was measured."""
    return answer["exit_code"] == 1 and any(words in str(answer["text"]) for words in EVIDENCE)


def _fresh(out: Path | None) -> Path:
    """A folder of this run's own: counters and logs of an earlier run are never mixed in or overwritten."""
    if out is not None:
        if out.exists() and any(out.iterdir()):
            raise UsageError(f"--out {out}: is not empty; name a new folder")
        chosen = out
    else:
        number = 1 + max((int(p.name[4:]) for p in Path("s2r-demo").glob("run-*") if p.name[4:].isdecimal()), default=0)
        chosen = Path("s2r-demo") / f"run-{number:03d}"
    try:
        chosen.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UsageError(f"{chosen}: cannot be made: {error.strerror}") from None
    return chosen.resolve()


@contextmanager
def _unwound_by(*numbers: signal.Signals) -> Iterator[None]:
    """These end the demo as Ctrl-C does, with the robot and the daemon that it has started: neither is to outlive it."""

    def leave(number: int, _frame: object) -> None:
        for other in numbers:
            signal.signal(other, signal.SIG_IGN)  # once is enough, and what ends them is not to be cut short
        raise EndedBySignal(number)

    heard = [number for number in numbers if signal.getsignal(number) is not signal.SIG_IGN]  # `nohup` has it go on
    before = {number: signal.signal(number, leave) for number in heard}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _private(folder: Path) -> Path:
    folder.mkdir(mode=0o700, exist_ok=True)
    return folder


def _free_ports(number: int) -> list[int]:
    with ExitStack() as stack:
        sockets = [stack.enter_context(socket.socket()) for _ in range(number)]
        for s in sockets:
            s.bind(("127.0.0.1", 0))
        return [int(s.getsockname()[1]) for s in sockets]


def _s2r(*argv: str) -> tuple[int, list[str]]:
    """(exit code, lines printed)."""
    done = subprocess.run([sys.executable, "-m", "s2r_runtime.cli.main", *argv], capture_output=True, text=True, check=False)
    return done.returncode, (done.stdout + done.stderr).splitlines()


def _answers(path: Path) -> bool:
    """Whether somebody listens: a socket is a file a moment before that."""
    with socket.socket(socket.AF_UNIX) as tried:
        return tried.connect_ex(str(path)) == 0


def _end(process: subprocess.Popen[str]) -> None:
    if process.poll() is None:
        process.terminate()
        try:
            process.wait(STOP_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
