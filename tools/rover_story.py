"""One full story on ArduPilot's rover, as a person would type it: every step is a verb of the command line, run as a process.

sample -> refused or certified -> trace -> adopt, if a model is proposed -> sample -> certificate -> drive -> a fault behind its back ->
revoked, recovery, refused -> audit. What comes back decides how the story goes on; nothing here looks into the daemon.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from rover_sitl import ROOT, Client, Simulator, profile_text, weaken

from s2r_runtime.messages import SERIAL

PROFILE, CONTROLLER = ROOT / "profiles" / "rover-mavlink.toml", ROOT / "controllers" / "rover_keep_out.py"
READY_S, END_S, JOB_S = 180.0, 60.0, 900.0
CAMPAIGN_S = 5400.0
"""The longest that a campaign is waited for, and its permit."""
CAMPAIGNS_MOST, GOES_ON = 5, "s2r sample goes on with it"
"""So often sampling is begun or resumed: after a stall of the disk, or a refusal of dependent samples (1 of 200 good campaigns)."""
LOOK_S = 2.0
AGAIN_MOST = 3
"""So often a controller that missed its deadline is cleared and deployed again."""
NOTICED_S = 120.0
"""So long a fault may stay unnoticed before the story goes on."""


class Ended(Exception):
    """The story cannot go on; its text says why. What was seen so far is kept."""


@dataclass
class Told:
    """What a story saw. times in s since its begin; `watched`: one row a look while it drove."""

    name: str
    folder: Path
    steps: list[dict[str, Any]] = field(default_factory=list)
    watched: list[dict[str, Any]] = field(default_factory=list)
    driven_s: float = 0.0
    closed: dict[str, float] = field(default_factory=dict)
    deployed_again: int = 0
    false_revocation: str = ""
    fault_at_s: float | None = None
    noticed_after_s: float | None = None
    reason_noticed: str = ""
    refused_again: bool | None = None
    audit_holds: bool | None = None
    logs: list[Path] = field(default_factory=list)
    error: str = ""

    @property
    def is_complete(self) -> bool:
        """Whether everything happened that should have."""
        return (
            not self.error
            and not self.false_revocation
            and self.noticed_after_s is not None
            and bool(self.refused_again and self.audit_holds)
        )


class Story:
    """minutes: of driving. share: what the motors still give after the fault. say: takes a line for a person."""

    def __init__(self, folder: Path, sitl: Path, number: int, minutes: float, share: float, say: Callable[[str], None]) -> None:
        folder.mkdir(parents=True)
        self._folder, self._sitl, self._minutes, self._share, self._say = folder, sitl, minutes, share, say
        self._robot = f"rover{number}"
        self.told = Told(self._robot, folder)
        self._environment = {**os.environ, "XDG_RUNTIME_DIR": str(folder), "XDG_STATE_HOME": str(folder / "home")}
        self._begin = time.monotonic()
        self._daemon: subprocess.Popen[bytes] | None = None

    def run(self) -> Told:
        """The story. Whatever happens, the processes end."""
        told = self.told
        try:
            with Simulator(self._folder / "sitl", self._sitl) as simulator:
                try:
                    self._tell(simulator)
                finally:
                    self._end_daemon()
            self._audit()
        except (Ended, TimeoutError, OSError) as error:
            told.error = str(error)
            self._say(f"ended: {error}")
        return told

    def _tell(self, simulator: Simulator) -> None:
        (self._folder / "rover.toml").write_text(profile_text(PROFILE, self._robot, simulator.address))
        self._start_daemon()
        self._until(self._is_ready, READY_S, "the robot to be ready to be driven")
        self._campaign()
        certified = self._deploy()
        if certified:
            self._s2r("undeploy")
        if self._repair():
            self._campaign()
            certified = self._deploy()
        elif certified:
            certified = self._deploy()
        if not certified:
            raise Ended("no certificate: the controller was refused")
        self._drive()
        if not self.told.false_revocation:
            self._fault(simulator)

    # ------------------------------------------------------------------ steps

    def _campaign(self) -> None:
        for _ in range(CAMPAIGNS_MOST):
            self._s2r("permit", f"{CAMPAIGN_S:.0f}")
            code, text = self._s2r("sample", "rover.toml", seconds=CAMPAIGN_S)
            if code == 0:
                return
            if not any(words in text for words in (SERIAL, GOES_ON)):
                break
        raise Ended(f"the campaign did not end with a gap: {text[-300:]}")

    def _repair(self) -> bool:
        """Whether a model was proposed, and adopted."""
        self._s2r("trace", "--live", "campaign", seconds=JOB_S)
        if not self._status().get("proposal"):
            return False
        return self._s2r("adopt")[0] == 0

    def _deploy(self) -> bool:
        return self._s2r("deploy", str(CONTROLLER), seconds=JOB_S)[0] == 0

    def _drive(self) -> None:
        told, before = self.told, time.monotonic()
        while told.driven_s < 60.0 * self._minutes:
            time.sleep(LOOK_S)
            status = self._look()
            now = time.monotonic()
            if status["gate"] == "open":
                told.driven_s += now - before
            else:
                told.closed[status["reason"]] = told.closed.get(status["reason"], 0.0) + now - before
            before = now
            if status.get("revoked"):
                told.false_revocation = f"after {told.driven_s:.0f} s of driving: {sorted(status['revoked'].values())}"
                self._say(f"revoked without a fault {told.false_revocation}")
                return
            if status["reason"] == "latched:controller_fault" and told.deployed_again < AGAIN_MOST:
                told.deployed_again += 1  # a busy computer kept it waiting: a person looks into it, clears it, and deploys again
                self._s2r("clear", "controller_fault")
                self._deploy()
            elif now - self._begin > 3.0 * CAMPAIGN_S or str(status["reason"]).startswith("latched:"):
                raise Ended(f"it drives no more: {status['reason']}")
        self._say(f"drove {told.driven_s:.0f} s; radius {status['radius']}, verified to {status['verified_radius']}")

    def _fault(self, simulator: Simulator) -> None:
        told = self.told
        client = Client(simulator.port + 2)
        try:
            weaken(client, self._share)
            told.fault_at_s = self._now()
            self._say(f"SIM_ENGINE_MUL = {self._share:g}, SIM_ENGINE_FAIL = 255 set by another client")
            while self._now() - told.fault_at_s < NOTICED_S:
                time.sleep(0.2)
                status = self._look()
                if status.get("revoked"):
                    told.noticed_after_s = self._now() - told.fault_at_s
                    told.reason_noticed = ", ".join(sorted(set(status["revoked"].values())))
                    break
        finally:
            client.close()
        if told.noticed_after_s is None:
            raise Ended(f"the fault was not noticed within {NOTICED_S:.0f} s")
        self._say(f"revoked {told.noticed_after_s:.1f} s after the fault: {told.reason_noticed}")
        told.refused_again = self._s2r("deploy", str(CONTROLLER), seconds=JOB_S)[0] == 1

    def _audit(self) -> None:
        self.told.logs = sorted((self._folder / "logs").glob("*.mcap"))
        names = [str(log) for log in self.told.logs]
        self.told.audit_holds = (
            bool(names) and self._s2r("audit", *names, "--key", "state/key.pub", "--rerun-controllers", seconds=JOB_S)[0] == 0
        )

    # ------------------------------------------------------------------ pieces

    def _now(self) -> float:
        return time.monotonic() - self._begin

    def _look(self) -> dict[str, Any]:
        """The status, noted."""
        status = self._status()
        kept = ("gate", "reason", "radius", "verified_radius", "e_value", "measured", "exceedances", "observation")
        self.told.watched.append({"at_s": self._now(), **{name: status.get(name) for name in kept}})
        return status

    def _status(self) -> dict[str, Any]:
        code, text = self._run("status", "--json")
        if code != 0:
            raise Ended(f"the daemon does not answer: {text[-300:]}")
        return dict(json.loads(text))

    def _is_ready(self) -> bool:
        code, text = self._run("status", "--json")
        seen = json.loads(text).get("observation") if code == 0 else None
        return bool(seen) and not seen["fault"]

    def _s2r(self, *verb: str, seconds: float = END_S) -> tuple[int, str]:
        """A verb that belongs to the story: shown and kept."""
        begin = self._now()
        self._say("$ s2r " + " ".join(Path(word).name if "/" in word else word for word in verb))
        code, text = self._run(*verb, seconds=seconds)
        self._say("   " + "\n   ".join(text.strip().splitlines()[:6]) + (f"\n   exit code {code}" if code else ""))
        self.told.steps.append({"verb": " ".join(verb), "at_s": begin, "seconds": self._now() - begin, "exit_code": code, "text": text})
        return code, text

    def _run(self, *verb: str, seconds: float = END_S) -> tuple[int, str]:
        argv = [sys.executable, "-m", "s2r_runtime", *verb]
        try:
            done = subprocess.run(
                argv, cwd=self._folder, env=self._environment, capture_output=True, text=True, timeout=seconds, check=False
            )
        except subprocess.TimeoutExpired:
            raise Ended(f"s2r {verb[0]} took more than {seconds:.0f} s") from None
        return done.returncode, done.stdout or done.stderr

    def _until(self, condition: Callable[[], bool], seconds: float, what: str) -> None:
        limit = time.monotonic() + seconds
        while not condition():
            said = (self._folder / "daemon.txt").read_text()[-500:]
            if self._daemon is not None and self._daemon.poll() is not None:
                raise Ended(f"the daemon ended: {said}")
            if time.monotonic() > limit:
                raise Ended(f"waited {seconds:.0f} s for {what}; the daemon said: {said}")
            time.sleep(LOOK_S)

    def _start_daemon(self) -> None:
        self._say("$ s2r run rover.toml")
        with (self._folder / "daemon.txt").open("wb") as said:
            argv = [sys.executable, "-m", "s2r_runtime", "run", "rover.toml", "--state", "state", "--log", "logs"]
            self._daemon = subprocess.Popen(
                argv, cwd=self._folder, env=self._environment, stdin=subprocess.DEVNULL, stdout=said, stderr=said
            )

    def _end_daemon(self) -> None:
        if self._daemon is None:
            return
        self._daemon.send_signal(signal.SIGTERM)
        try:
            self._daemon.wait(END_S)
        except subprocess.TimeoutExpired:
            self._daemon.kill()
            self._daemon.wait()
