"""Faults in a running daemon, one after the other: real processes, a real transport, and between two faults a controller that drives.

Each fault says how it is brought about and what the daemon must have said of it. When its cause has gone, a certified controller must
drive again (`Drill.drive`). At the end `judged` reads the logs: every event is handed to the law of `core_law`, which knows nothing of
the core, together with what the core makes of it; and every command that reached the robot must be one that stands in a log, with
an input that a certified controller gives.
"""

from __future__ import annotations

import os
import random
import resource
import shutil
import signal
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
from core_law import Law
from daemon_rig import Rig

from s2r_runtime import gate
from s2r_runtime.core import reducer as core
from s2r_runtime.errors import S2RError
from s2r_runtime.messages import Send, SourceStopped, Started
from s2r_runtime.recording.reading import read

GOOD_U, BAD_U, FOREIGN_U = 0.5, 0.25, 0.111
"""What turns the robot: the good controller, one that is going to fail, and one that must never drive."""
AGAIN_S = 180.0
"""From the end of a cause to a controller that drives, on a busy machine."""


@dataclass
class Outcome:
    """reasons: what the gate said between the fault and the controller that drove again."""

    fault: str
    reasons: list[str]
    seconds: float


class Drill:
    """One robot, one daemon at a time, and its faults."""

    GROWN = 0.02
    """Beyond this the gap of the made-up certificates is given up, and the next one founds an epoch of its own."""

    def __init__(self, folder: Path, *, clock: str = "realtime", seed: int = 1, rig: Rig | None = None) -> None:
        self.rig = rig or Rig(folder, clock=clock)
        self.rng = random.Random(seed)
        self.killed = 0
        """How often a daemon, or its recorder, ended without a word: the end of that log may be missing."""
        self._numbers = self._before = 0
        self._certificates: dict[tuple[Path, int], str] = {}
        self.good = self.rig.controller()

    # ------------------------------------------------------------------ what should be

    def begin(self) -> None:
        self.rig.start_robot()
        self.rig.start()
        self.drive()

    def drive(self) -> None:
        """Whatever a person and a service manager would do until a controller drives."""
        rig, limit = self.rig, time.monotonic() + AGAIN_S
        while time.monotonic() < limit:
            try:
                if self._towards_driving():
                    return
            except (S2RError, OSError):  # it ends, or has ended
                time.sleep(0.1)
        raise AssertionError(f"does not drive again: {rig.status()}; {rig.said()[-2000:]}")

    def _towards_driving(self) -> bool:
        rig = self.rig
        if rig.robot is None or rig.robot.poll() is not None:
            rig.start_robot()
        if rig.daemon is None or rig.daemon.poll() is not None:
            rig.start()
        status = rig.status()
        if (status["gate"], status["reason"], status["driving"]) == ("open", gate.ALLOWED, "controller"):
            return True
        for reason in status["latched"]:
            rig.ask("clear", text=reason)
        if status["stage"] == "running" and status["reason"].removeprefix("latched:") in DEPLOY_AGAIN:
            rig.ask("undeploy")
        if status["controller"] is None and status["observation"]:
            self.deploy(self.good)
        time.sleep(0.05)
        return False

    def deploy(self, path: Path) -> dict[str, Any]:
        """Under a certificate of its own; a new one if the last was revoked or its gap refuted."""
        status = self.rig.status()
        epoch = max(1, status["epoch"]) + (1 if status["alarm"] or (status["radius"] or 0.0) > self.GROWN else 0)
        kept = self._certificates.get((path, epoch))
        if kept is None or any(one in kept for one in status["revoked"]):
            self._numbers += 1
            kept = self.rig.certificate(path, verified=self.GROWN + 1e-9 * self._numbers, epoch=epoch)
            self._certificates[path, epoch] = kept
        return self.rig.ask("deploy", path=str(path), certificate=kept)

    def says(self, *reasons: str) -> None:
        """Waits until the gate has said one of these since the fault."""
        self.rig.until(lambda: {*self.reasons(), self.rig.status()["reason"].removeprefix("latched:")} & set(reasons))

    def reasons(self) -> list[str]:
        """What the gate said since the fault."""
        file = self.rig.folder / "said.jsonl"
        lines = file.read_bytes().splitlines()[self._before :] if file.exists() else []
        return [msgspec.json.decode(line)["reason"].removeprefix("latched:") for line in lines]

    def run(self, name: str) -> Outcome:
        """One fault and its end. AssertionError if it was not noticed, or did not mend."""
        self._before = 0
        self._before = len(self.reasons())
        begun = time.monotonic()
        FAULTS[name](self)
        self.drive()
        found = [one for one in dict.fromkeys(self.reasons()) if one not in (gate.ALLOWED, "settling")]
        assert set(found) <= set(gate.REASONS), found
        return Outcome(name, found, time.monotonic() - begun)

    # ------------------------------------------------------------------ hands

    def bad(self, body: str) -> Path:
        """A controller that drives well until it has turned by 0.2 rad, and then does this."""
        lines = f"    if abs(x[0, 2] - START.setdefault('at', x[0, 2])) > 0.1:\n{body}    return np.tile([0.0, {BAD_U}], (len(x), 1))\n"
        path = self.rig.controller(lines, f"bad{self._numbers}.py")
        path.write_text("START = {}\n" + path.read_text())
        return path

    def fails(self, body: str, *reasons: str) -> None:
        """A controller that fails as it drives, and how the log must say that it went."""
        self.rig.ask("undeploy")
        self._numbers += 1
        assert self.deploy(self.bad(body))["exit_code"] == 0
        self.says("controller_fault")
        self.rig.until(lambda: self._stopped() in reasons)

    def _stopped(self) -> str:
        """How the newest log says that the last controller went."""
        entries = [entry.message for entry in read(self.rig.log_files()[-1], ["event/source_stopped"])]
        return next((m.reason for m in reversed(entries) if isinstance(m, SourceStopped) and m.source == "controller"), "")

    def sabotage(self, what: str, value: float = 0.0) -> None:
        self.rig.to_daemon(sabotage=what, value=value)

    def signal(self, pid: int, how: signal.Signals) -> None:
        os.kill(pid, how)

    @property
    def pid(self) -> int:
        assert self.rig.daemon is not None
        return self.rig.daemon.pid

    def restarted(self) -> None:
        """It is down, and comes up."""
        assert self.rig.daemon is not None
        self.rig.daemon.wait(30.0)
        self.rig.start()


DEPLOY_AGAIN = ("certificate_revoked", "no_certificate", "certificate_expired", "digest_mismatch", "measurement_faults")


# ---------------------------------------------------------------- controllers


def _leaks(drill: Drill) -> None:
    drill.fails("        kept = []\n        while True:\n            kept.append(np.ones(1 << 22))\n", "raised", "died", "deadline")


def _prints(drill: Drill) -> None:
    """What it writes goes nowhere, and it drives on."""
    drill.rig.ask("undeploy")
    drill._numbers += 1
    path = drill.rig.controller(f"    print('x' * 10000)\n    return np.tile([0.0, {BAD_U}], (len(x), 1))\n", f"prints{drill._numbers}.py")
    assert drill.deploy(path)["exit_code"] == 0
    drill.rig.until_status(gate="open", driving="controller")
    before = len(drill.rig.applied())
    drill.rig.until(lambda: len(drill.rig.applied()) > before + 10)
    assert drill.rig.status()["gate"] == "open"
    drill.rig.ask("undeploy")


def _controller_signalled(how: signal.Signals) -> Callable[[Drill], None]:
    def fault(drill: Drill) -> None:
        drill.signal(drill.rig.status()["pids"]["controller"], how)
        drill.says("controller_fault")

    return fault


def _file_changed(drill: Drill) -> None:
    """The file is not what runs: what runs was loaded when it was deployed."""
    drill.rig.controller(f"    return np.tile([0.0, {FOREIGN_U}], (len(x), 1))\n")
    before = len(drill.rig.applied())
    drill.rig.until(lambda: len(drill.rig.applied()) > before + 10)
    assert all(command["u"] != [0.0, FOREIGN_U] for command in drill.rig.applied())
    drill.rig.controller()


def _uncertified(drill: Drill) -> None:
    """Another controller, under the certificate of the one that drives, and under one that was changed."""
    rig, foreign = drill.rig, drill.rig.controller(f"    return np.tile([0.0, {FOREIGN_U}], (len(x), 1))\n", "foreign.py")
    good = drill.rig.certificate(drill.good, verified=1.05 * drill.GROWN)
    assert rig.ask("deploy", path=str(foreign), certificate=good)["exit_code"] != 0
    rig.ask("undeploy")
    place = drill.rng.randrange(len(good))
    changed = good[:place] + chr(ord(good[place]) ^ 1) + good[place + 1 :]
    assert rig.ask("deploy", path=str(drill.good), certificate=changed)["exit_code"] != 0
    assert rig.ask("deploy", path=str(foreign), certificate=changed)["exit_code"] != 0
    assert rig.status()["gate"] == "closed"
    rig.until(lambda: rig.status()["job"] is None)


# ---------------------------------------------------------------- processes


def _analytics(how: signal.Signals) -> Callable[[Drill], None]:
    def fault(drill: Drill) -> None:
        pid = drill.rig.status()["pids"]["analytics"]
        drill.signal(pid, how)
        drill.says("analytics_down")

    return fault


def _worker_killed(drill: Drill) -> None:
    """Mid-verification: the attempt is spent, nothing is certified."""
    rig = drill.rig
    rig.ask("undeploy")
    drill._numbers += 1
    attempts = rig.status()["attempts"]
    body = f"    time.sleep(0.05)\n    return np.tile([0.0, {FOREIGN_U}], (len(x), 1))\n"
    answer = rig.background("deploy", path=str(rig.controller(body, f"slow{drill._numbers}.py")))
    pids = rig.until(lambda: rig.status()["job"] == "deploy" and rig.children("s2r_runtime.daemon.worker"))
    drill.signal(pids[0], signal.SIGKILL)
    assert answer()["exit_code"] == 1
    assert rig.status()["attempts"] == attempts + 1
    drill.says("no_certificate")


def _daemon_stopped(seconds: float) -> Callable[[Drill], None]:
    def fault(drill: Drill) -> None:
        drill.signal(drill.pid, signal.SIGSTOP)
        time.sleep(seconds)
        drill.signal(drill.pid, signal.SIGCONT)
        drill.says("observation_stale", "controller_fault", "link_down", "command_stale")

    return fault


def _daemon_killed(drill: Drill) -> None:
    drill.rig.kill()
    drill.killed += 1
    drill.restarted()
    assert drill.rig.status()["gate"] == "closed"


def _daemon_ended(drill: Drill) -> None:
    assert drill.rig.stop() == 0
    drill.restarted()
    assert drill.rig.status()["gate"] == "closed"


def _second_daemon(drill: Drill) -> None:
    code, said = drill.rig.refused()
    assert code == 78, said
    assert drill.rig.status()["gate"] == "open"


# ---------------------------------------------------------------- disk


def limit_files(pid: int, size: int) -> None:
    """What a file of that process may grow to: a full disk, but for the error's number."""
    resource.prlimit(pid, resource.RLIMIT_FSIZE, (size, resource.RLIM_INFINITY))


def _disk_full(drill: Drill) -> None:
    limit_files(drill.pid, drill.rig.log_files()[-1].stat().st_size + drill.rng.choice([0, 100, 4096]))
    drill.says("recorder_down")
    limit_files(drill.pid, resource.RLIM_INFINITY)
    drill.rig.until_status(recorder="ok")


def _state_refused(drill: Drill) -> None:
    """A stop that can't be saved stops all the same."""
    limit_files(drill.pid, 50)
    assert drill.rig.ask("stop")["exit_code"] == 0
    drill.says("emergency_stop")
    drill.rig.until(lambda: drill.rig.status()["recorder"] != "ok")
    limit_files(drill.pid, resource.RLIM_INFINITY)
    drill.rig.until_status(recorder="ok")


def _slow_disk(drill: Drill) -> None:
    """Driving does not wait for it; what it can't take in time closes the gate."""
    drill.sabotage("slow disk", drill.rng.choice([0.3, 3.0]))
    time.sleep(drill.rng.choice([0.5, 4.0]))
    drill.sabotage("slow disk", 0.0)


def _recorder_dead(drill: Drill) -> None:
    """Its log is at its end; the daemon begins another with a recorder of its own."""
    before = len(drill.rig.log_files())
    drill.killed += 1
    drill.sabotage("recorder dead")
    drill.says("recorder_down")
    drill.rig.until(lambda: len(drill.rig.log_files()) > before)
    drill.rig.until_status(recorder="ok")


def _state_file(change: Callable[[bytes, random.Random], bytes]) -> Callable[[Drill], None]:
    """The daemon does not start with a state that is not as it wrote it."""

    def fault(drill: Drill) -> None:
        rig, file = drill.rig, drill.rig.state / "state.json"
        rig.stop()
        kept = file.read_bytes()
        file.write_bytes(change(kept, drill.rng))
        code, said = rig.refused()
        assert code == 78, said
        assert "state" in said.splitlines()[-1]
        file.write_bytes(kept)
        drill.restarted()

    return fault


def _resealed(**changes: Any) -> Callable[[bytes, random.Random], bytes]:
    from s2r_runtime.files.durable import seal

    def change(data: bytes, _: random.Random) -> bytes:
        return seal("state", {**msgspec.json.decode(data)["content"], **changes})

    return change


def _state_gone(drill: Drill) -> None:
    rig = drill.rig
    rig.stop()
    shutil.move(rig.state / "state.json", rig.folder / "kept.json")
    code, said = rig.refused()
    assert (code, "is missing" in said) == (78, True), said
    shutil.move(rig.folder / "kept.json", rig.state / "state.json")
    drill.restarted()


# ---------------------------------------------------------------- clocks


def _monotonic(drill: Drill) -> None:
    """The host's clock steps, and steps back when that is over."""
    step = drill.rng.choice([-30.0, -1.0, 1.0, 30.0])
    drill.sabotage("monotonic clock", step)
    drill.says("clock_backwards", "observation_stale", "controller_fault", "link_down", "command_stale")
    drill.sabotage("monotonic clock", 0.0)


def _wall(drill: Drill) -> None:
    """So far that nobody can tell whether the certificate expired."""
    drill.sabotage("wall clock", drill.rng.choice([-4000.0, 4000.0, 1e8]))
    drill.says("certificate_expired")
    drill.sabotage("wall clock", 0.0)
    time.sleep(1.1)  # it is read once a second


# ---------------------------------------------------------------- robot and transport


def _robot_signalled(how: signal.Signals) -> Callable[[Drill], None]:
    def fault(drill: Drill) -> None:
        robot = drill.rig.robot
        assert robot is not None
        drill.signal(robot.pid, how)
        if how == signal.SIGKILL:
            robot.wait()
        drill.says("link_down", "observation_stale")
        drill.signal(robot.pid, signal.SIGCONT) if how == signal.SIGSTOP else None

    return fault


def _seen(*reasons: str, **fields: Any) -> Callable[[Drill], None]:
    """Something on the robot's side says that it is there; it is believed for as long as nothing better comes."""

    def fault(drill: Drill) -> None:
        ahead = drill.rig.status()["observation"]["seq"] + 500  # a number that the robot does not come to meanwhile
        plain = {"seq": ahead, "stamp_ns": ahead * 33_000_000, "x": [0.0, 0.0, 0.0], **fields}
        plain["seq"] += plain.pop("later", 0)
        for _ in range(3):
            drill.rig.to_daemon(**plain)
        if reasons:
            drill.says(*reasons)
        time.sleep(0.2)

    return fault


def _garbage(drill: Drill) -> None:
    before = drill.rig.status()["counters"]["malformed"]
    for size in (0, 1, 100, 60_000):
        drill.rig.to_daemon(garbage="x" * size)
    drill.rig.until(lambda: drill.rig.status()["counters"]["malformed"] >= before + 4)


def _raises(drill: Drill) -> None:
    drill.rig.to_daemon(**{"raise": "a defect of the plug-in"})
    drill.says("link_down")


def _slow(drill: Drill) -> None:
    drill.sabotage("hang", 1.2)
    drill.says("observation_stale", "controller_fault", "command_stale", "link_down")


def _hangs(drill: Drill) -> None:
    """For longer than any call may take: the plug-in is not asked again by this daemon."""
    drill.sabotage("hang", 3.0)
    drill.says("link_down")
    drill.rig.until(lambda: drill.rig.status()["link_trouble"])
    drill.rig.stop()
    drill.restarted()


def _impostor(drill: Drill) -> None:
    for _ in range(5):
        drill.rig.to_daemon(command=[0.0, FOREIGN_U])
    time.sleep(0.2)
    assert drill.rig.status()["gate"] == "open"


# ---------------------------------------------------------------- people


def _stop(drill: Drill) -> None:
    assert drill.rig.ask("stop")["exit_code"] == 0
    drill.says("emergency_stop")
    assert drill.deploy(drill.good)["exit_code"] == 1


def _button(drill: Drill) -> None:
    drill.rig.to_daemon(estop=True)
    drill.says("emergency_stop")


def _revoke(drill: Drill) -> None:
    assert drill.rig.ask("revoke")["exit_code"] == 0
    drill.says("certificate_revoked")


def _nonsense(drill: Drill) -> None:
    for request in ({"verb": "dance"}, {"verb": "permit", "duration_s": "long"}, {"verb": "clear", "text": "nothing"}, {"verb": "sample"}):
        assert drill.rig.ask(**request)["exit_code"] != 0  # type: ignore[arg-type]
    assert drill.rig.status()["gate"] == "open"


FAULTS: dict[str, Callable[[Drill], None]] = {
    "controller raises": lambda drill: drill.fails("        raise ValueError('too far')\n", "raised"),
    "controller hangs": lambda drill: drill.fails("        time.sleep(60)\n", "deadline"),
    "controller runs in circles": lambda drill: drill.fails("        while True:\n            pass\n", "deadline"),
    "controller gives NaN": lambda drill: drill.fails("        return np.full((len(x), 2), np.nan)\n", "malformed"),
    "controller gives inf": lambda drill: drill.fails("        return np.full((len(x), 2), np.inf)\n", "malformed"),
    "controller gives a wrong shape": lambda drill: drill.fails("        return np.zeros((len(x), 3))\n", "malformed"),
    "controller gives text": lambda drill: drill.fails("        return 'forward'\n", "malformed", "raised"),
    "controller exits": lambda drill: drill.fails("        import os\n        os._exit(3)\n", "died", "raised"),
    "controller raises SystemExit": lambda drill: drill.fails("        raise SystemExit(0)\n", "died", "raised"),
    "controller forks": lambda drill: drill.fails(
        "        import os\n        os.fork()\n        raise ValueError('forked')\n", "raised", "died"
    ),
    "controller leaks memory": _leaks,
    "controller recurses": lambda drill: drill.fails("        f = lambda n: f(n + 1)\n        f(0)\n", "raised", "died"),
    "controller prints": _prints,
    "controller killed": _controller_signalled(signal.SIGKILL),
    "controller frozen": _controller_signalled(signal.SIGSTOP),
    "controller's file changed": _file_changed,
    "controller without a certificate": _uncertified,
    "analytics killed": _analytics(signal.SIGKILL),
    "analytics frozen": _analytics(signal.SIGSTOP),
    "worker killed": _worker_killed,
    "daemon stopped for 1 s": _daemon_stopped(1.0),
    "daemon stopped for 10 s": _daemon_stopped(10.0),
    "daemon killed": _daemon_killed,
    "daemon ended": _daemon_ended,
    "second daemon": _second_daemon,
    "disk full": _disk_full,
    "state refused by the disk": _state_refused,
    "disk slow": _slow_disk,
    "recorder dead": _recorder_dead,
    "state truncated": _state_file(lambda data, rng: data[: rng.randrange(len(data))]),
    "state flipped": _state_file(lambda data, rng: _flipped(data, rng.randrange(8 * len(data)))),
    "state of another robot": _state_file(_resealed(robot="another")),
    "state from the future": _state_file(_resealed(schema=99)),
    "state gone": _state_gone,
    "monotonic clock steps": _monotonic,
    "wall clock steps": _wall,
    "robot killed": _robot_signalled(signal.SIGKILL),
    "robot frozen": _robot_signalled(signal.SIGSTOP),
    "observation not finite": _seen("observation_invalid", x=[float("nan"), 0.0, 0.0]),
    "observation infinite": _seen("observation_invalid", x=[0.0, float("-inf"), 0.0]),
    "observation huge": _seen("outside_region", x=[1e308, 0.0, 0.0]),
    "observation too short": _seen("observation_invalid", x=[0.0]),
    "observation of the past": _seen("observation_out_of_order", seq=1, stamp_ns=1),
    "observation of the future": _seen(later=10**6, stamp_ns=10**15),
    "observation repeated": _seen(),
    "garbage": _garbage,
    "transport raises": _raises,
    "transport slow": _slow,
    "transport hangs": _hangs,
    "an outsider commands": _impostor,
    "stop": _stop,
    "robot's button": _button,
    "revoked": _revoke,
    "nonsense on the control socket": _nonsense,
}


def _flipped(data: bytes, place: int) -> bytes:
    changed = bytearray(data)
    changed[place // 8] ^= 1 << place % 8
    return bytes(changed)


# ---------------------------------------------------------------- the judgement


def judged(drill: Drill) -> dict[str, int]:
    """Every event of every log by the law, and every command that reached the robot by the logs. What was counted on the way."""
    sent, count = lawful(drill)
    known = {(one.source, one.seq, tuple(one.u), one.obs_seq) for one in sent}
    for command in drill.rig.applied():
        count["commands"] += 1
        u = tuple(command["u"])
        assert u in {(0.0, 0.0), (0.0, GOOD_U), (0.0, BAD_U)}, command
        assert (command["source"] == "recovery") == (u == (0.0, 0.0)), command
        count["unrecorded"] += u != (0.0, 0.0) and (command["source"], command["seq"], u, command["obs_seq"]) not in known
    # what a killed daemon sent in its last moments may be missing: 100 ms of the log, and as much of a busy machine
    assert count["unrecorded"] <= 30 * drill.killed, count
    return count


def lawful(drill: Drill) -> tuple[list[Send], dict[str, int]]:
    """Every event of every log by the law; what the core sends, and what was counted."""
    law, sent, count = None, [], {"events": 0, "commands": 0, "unrecorded": 0}
    for path in drill.rig.log_files():
        state = core.initial()
        for entry in read(path):
            if not entry.channel.startswith("event/"):
                continue
            event: Any = entry.message
            if isinstance(event, Started):
                law = law or Law(event.settings)
                law.requests = law.final = frozenset()  # every run numbers its requests anew
            state, outputs = core.handle(state, event)
            assert law is not None
            law.judge(event, outputs)
            sent += [one for one in outputs if isinstance(one, Send)]
            count["events"] += 1
    return sent, count
