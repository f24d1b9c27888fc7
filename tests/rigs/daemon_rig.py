"""A daemon and its robot as processes, talked to over the control socket: what tests of the daemon are written with."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec

from s2r_runtime.controllers.file import load
from s2r_runtime.core.ledger import campaign_size, sample_size, share
from s2r_runtime.daemon import control
from s2r_runtime.errors import S2RError
from s2r_runtime.messages import Gap, LawResult, Struct, Tries, Verification
from s2r_runtime.profile import load_profile
from s2r_runtime.recording.reading import read
from s2r_runtime.trust import certificate, keys

PROGRAM = Path(__file__).with_name("loop_robot.py")
WITHIN_S = 60.0
"""For anything that should happen soon, on a busy machine."""

PROFILE = """
clock = "{clock}"
[robot]
name = "rig"
[model]
name = "unicycle"
dt = 0.033
[[model.effects]]
name = "input_delay"
channel = "*"
parameters = {{ delay = 0.033 }}
[[model.effects]]
name = "wheel_saturation"
channel = "*"
parameters = {{ speed = 0.2, track = 0.105 }}
[[model.effects]]
name = "integration_scheme"
parameters = {{ scheme = "exact" }}
[region]
x = [-1.6, 1.6]
y = [-1.0, 1.0]
[inputs]
v = [-0.2, 0.2]
w = [-3.1, 3.1]
[norm]
weights = {{ theta = 0.0525 }}
[sampling]
hold_periods = 5
[guarantee]
epsilon = 0.3
beta = 0.5
[verification]
epsilon = 0.3
[gate]
controller_deadline = 0.5
command_ttl = 0.5
observation_timeout = 0.5
[task]
name = "grid_world"
[transport]
name = "loop"
folder = "."
{more}
"""
"""epsilon and beta that ask for few samples: what is tested here is not the statistics."""


class Rig:
    """One robot, one daemon (or several after each other), one folder."""

    def __init__(self, folder: Path, *, clock: str = "lockstep", more: str = "") -> None:
        self.folder, self.state, self.logs = folder, folder / "state", folder / "logs"
        self.profile = folder / "rig.toml"
        self.profile.write_text(PROFILE.format(clock=clock, more=more))
        self.environment = {**os.environ, "XDG_RUNTIME_DIR": str(folder)}
        self.environment |= {"XDG_STATE_HOME": str(folder / "home"), "XDG_CONFIG_HOME": str(folder / "config")}
        self.robot: subprocess.Popen[bytes] | None = None
        self.daemon: subprocess.Popen[bytes] | None = None
        self._clock = clock

    # ------------------------------------------------------------------ processes

    def start_robot(self, *options: str) -> None:
        realtime = ["--realtime"] if self._clock == "realtime" else []
        self.robot = subprocess.Popen([sys.executable, str(PROGRAM), "robot", str(self.folder), *realtime, *options])

    def start(self, *options: str, environment: dict[str, str] | None = None) -> None:
        """The daemon; returns when it serves."""
        self.daemon = self._spawn("daemon", str(self.profile), "--log", str(self.logs), *options, environment=environment)
        self.until(lambda: control._listening(self.socket) or (self.daemon is not None and self.daemon.poll() is not None))
        assert self.daemon.poll() is None, self.said()

    def refused(self, *options: str) -> tuple[int, str]:
        """A daemon that does not start: exit code and what it said."""
        process = self._spawn("daemon", str(self.profile), "--log", str(self.logs), *options, output="refused.txt")
        return process.wait(WITHIN_S), (self.folder / "refused.txt").read_text()

    def campaign(self, out: Path, *options: str) -> subprocess.Popen[bytes]:
        """One campaign without a daemon, under way. Its answer goes to `campaign.json`."""
        with (self.folder / "campaign.json").open("wb") as answer:
            return self._spawn("campaign", str(self.profile), str(out), *options, output="campaign.txt", stdout=answer)

    def _spawn(
        self, *argv: str, output: str = "daemon.txt", stdout: Any = None, environment: dict[str, str] | None = None
    ) -> subprocess.Popen[bytes]:
        with (self.folder / output).open("ab") as sink:
            return subprocess.Popen(
                [sys.executable, str(PROGRAM), *argv, "--state", str(self.state)],
                stdout=stdout or sink,
                stderr=sink,
                env={**self.environment, **(environment or {})},
                cwd=self.folder,
            )

    def stop(self) -> int:
        """SIGTERM, and the exit code."""
        assert self.daemon is not None
        self.daemon.terminate()
        return self.daemon.wait(WITHIN_S)

    def kill(self) -> None:
        """SIGKILL."""
        assert self.daemon is not None
        self.daemon.kill()
        self.daemon.wait()

    def close(self) -> None:
        for process in (self.daemon, self.robot):
            if process is not None and process.poll() is None:
                process.send_signal(signal.SIGCONT)
                process.kill()
                process.wait()

    def said(self) -> str:
        """What the daemons said on stderr."""
        return (self.folder / "daemon.txt").read_text()

    # ------------------------------------------------------------------ requests

    @property
    def socket(self) -> Path:
        return self.folder / "s2r" / "rig.sock"

    def ask(self, verb: str, heard: list[dict[str, Any]] | None = None, **fields: Any) -> dict[str, Any]:
        return control.call(self.socket, {"verb": verb, **fields}, heard.append if heard is not None else None)

    def background(self, verb: str, **fields: Any) -> Callable[[], dict[str, Any]]:
        """A request whose answer is waited for later, by calling what this gives."""
        kept: list[dict[str, Any]] = []
        thread = threading.Thread(target=lambda: kept.append(self._quietly(verb, fields)), daemon=True)
        thread.start()

        def answer() -> dict[str, Any]:
            thread.join(WITHIN_S)
            return kept[0]

        return answer

    def _quietly(self, verb: str, fields: dict[str, Any]) -> dict[str, Any]:
        try:
            return self.ask(verb, **fields)
        except S2RError as error:  # the daemon ended first
            return {"exit_code": error.exit_code, "text": str(error)}

    def children(self, module: str) -> list[int]:
        """Processes of the daemon that run this module."""
        assert self.daemon is not None
        found = []
        for pid in Path(f"/proc/{self.daemon.pid}/task/{self.daemon.pid}/children").read_text().split():
            with contextlib.suppress(OSError):
                if module.encode() in Path(f"/proc/{pid}/cmdline").read_bytes().split(b"\0"):
                    found.append(int(pid))
        return found

    def status(self) -> dict[str, Any]:
        return dict(self.ask("status")["data"])

    def until(self, condition: Callable[[], Any]) -> Any:
        """Waits for it; returns its value."""
        limit = time.monotonic() + WITHIN_S
        while time.monotonic() < limit:
            if value := condition():
                return value
            time.sleep(0.02)
        raise AssertionError(f"did not happen within {WITHIN_S} s; the daemon said: {self.said()[-2000:]}")

    def until_status(self, **wanted: Any) -> dict[str, Any]:
        """Waits until the status has these values."""

        def there() -> dict[str, Any] | None:
            found = self.status()
            return found if all(found[name] == value for name, value in wanted.items()) else None

        return dict(self.until(there))

    def sample(self) -> dict[str, Any]:
        """A campaign, begun as soon as the robot is seen."""
        self.until(lambda: self.status()["observation"])
        self.ask("permit", duration_s=3600.0)
        return self.ask("sample")

    # ------------------------------------------------------------------ controllers

    def controller(self, body: str = "    return np.tile([0.0, 0.5], (len(x), 1))\n", name: str = "controller.py") -> Path:
        """A controller's file; by default it turns on the spot."""
        path = self.folder / name
        path.write_text(f"import time\nimport numpy as np\n\n\ndef control(x, theta, parameters):\n{body}")
        return path

    def certificate(self, controller: Path, *, radius: float = 0.01, verified: float = 0.02, epoch: int = 1) -> str:
        """A made-up certificate, signed with the robot's own key."""
        return made_up_certificate(self.profile, self.state / "key.pem", controller, radius=radius, verified=verified, epoch=epoch)

    def deploy(self, controller: Path | None = None, **fields: Any) -> dict[str, Any]:
        """Deploys a controller under a certificate for it."""
        path = controller or self.controller()
        self.until(lambda: self.status()["observation"])
        return self.ask("deploy", path=str(path), certificate=self.certificate(path), **fields)

    # ------------------------------------------------------------------ what happened

    def messages(self, *channels: str) -> list[Struct]:
        """What the logs hold on these channels, oldest first."""
        return [entry.message for path in self.log_files() for entry in read(path, channels)]

    def s2r(self, *verb: str) -> subprocess.CompletedProcess[str]:
        """A verb of the command line, which knows this rig's transport too."""
        argv = [sys.executable, str(PROGRAM), "s2r", *verb]
        return subprocess.run(argv, capture_output=True, text=True, env=self.environment, cwd=self.folder, check=False, timeout=100)

    def log_files(self) -> list[Path]:
        return sorted(self.logs.glob("*.mcap"), key=lambda path: path.stat().st_mtime_ns)

    def applied(self) -> list[dict[str, Any]]:
        """Every command that reached the robot."""
        return [msgspec.json.decode(line) for line in (self.folder / "applied.jsonl").read_bytes().splitlines()]

    def to_daemon(self, **fields: Any) -> None:
        """A datagram from somewhere on the robot's side."""
        import socket

        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sock:
            sock.sendto(json.dumps(fields).encode(), str(self.folder / "daemon.sock"))


def made_up_certificate(
    profile_path: Path,
    key: Path,
    controller: Path,
    *,
    radius: float,
    verified: float,
    epoch: int,
    weights: tuple[float, ...] | None = None,
    tries: Tries | None = None,
) -> str:
    """A certificate for a controller. Its evidence is made up: nothing was sampled or verified, and every epoch has samples of its own.

    weights: one a state; if not said, the profile's for (x, y, theta).
    """
    profile, file = load_profile(profile_path), load(controller)
    beta, epsilon = profile.guarantee.beta, profile.guarantee.epsilon
    gap = Gap(
        radius=radius,
        radius_literal=radius,
        hold_radius=radius,
        hold_periods=5,
        set="ball",
        weights=tuple(profile.norm.weights.get(name, 1.0) for name in ("x", "y", "theta")) if weights is None else weights,
        n=campaign_size(epsilon, share(beta, epoch), 0),
        discarded=0,
        epsilon=epsilon,
        beta=share(beta, epoch),
        epoch=epoch,
        model_digest=profile.model.digest(),
        transitions_digest=f"sha256:{epoch:064x}",
    )
    n = sample_size(profile.verification.epsilon, share(beta, 1))
    laws = tuple(
        LawResult(name, n, 0.2, 0, 0.3, 1.0, progress_ok=True, required=True, passed=True) for name in profile.verification.required
    )
    verification = Verification(
        passed=True,
        radius=verified,
        hold_radius=verified,
        threshold=profile.verification.threshold,
        epsilon=profile.verification.epsilon,
        beta=share(beta, 1),
        attempt=1,
        seed=1,
        laws=laws,
        controller_digest=file.digest,
        model_digest=profile.model.digest(),
        task_digest=profile.task_digest(),
    )
    issued = certificate.issue(
        profile=profile, controller=file, gap=gap, verification=verification, issued_unix_s=int(time.time()), lifetime_s=3600, tries=tries
    )
    return certificate.sign(issued, keys.load(key)).decode()
