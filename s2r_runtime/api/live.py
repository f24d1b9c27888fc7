"""A running daemon: what `s2r status`, `permit`, `sample`, `deploy`, `stop` and the others, and `s2r.connect`, request of it."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from s2r_runtime.api.options import check_counts, check_named_numbers, check_numbers
from s2r_runtime.api.progress import Callback, Watcher, watcher_of
from s2r_runtime.api.results import Result
from s2r_runtime.api.spelling import front_door, in_python
from s2r_runtime.daemon import control
from s2r_runtime.errors import ConfigError, NotEnoughEvidence, S2RError, UsageError
from s2r_runtime.files.bounded_file import read_bounded

if TYPE_CHECKING:
    from types import TracebackType

WAITING = ("sample", "excite", "deploy", "trace", "verify")
"""Requests whose answer takes long. A client that leaves before it stops what drives for it."""
REFUSED = 1
"""Exit code of an answer that something does not hold."""
_ERRORS = {error.exit_code: error for error in (UsageError, NotEnoughEvidence, ConfigError)}


@dataclass(frozen=True, repr=False)
class Answer(Result):
    """The daemon's answer to a request that it accepted or refused."""

    ok: bool
    """Whether it was done; False: refused, and `text` has the reason."""
    text: str
    data: Any = None

    def to_dict(self) -> dict[str, Any]:
        """What the command prints with `--json`."""
        return {"exit_code": 0 if self.ok else REFUSED, "text": self.text, "data": self.data}

    def summary(self) -> str:
        """The text."""
        return self.text


class Daemon(AbstractContextManager["Daemon"]):
    """A running daemon. Every call is a connection of its own, so nothing is held open; `with` only marks where it is used.

    A request that the daemon refuses gives an `Answer` whose `ok` is False. One that makes no sense raises UsageError, one for which the
    data do not suffice NotEnoughEvidence. While `sample`, `deploy` or `trace` waits, an interrupt (Ctrl-C) stops what drives for it.
    """

    def __init__(self, socket: Path) -> None:
        self.socket = socket
        """The daemon's control socket."""

    def __repr__(self) -> str:
        return f"<Daemon: {self.socket}>"

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        """Leaves the daemon and the robot as they are."""

    def status(self) -> dict[str, Any]:
        """What the daemon is doing, and why: the keys of `s2r status --json` (docs/json.md)."""
        return dict(self._request({"verb": "status"}).data or {})

    def permit(self, seconds: float) -> Answer:
        """Lets the sampler drive inside the geofence for this time in s from now on; 0 ends it."""
        check_numbers(seconds=seconds)
        if not 0.0 <= seconds < float("inf"):
            raise UsageError(f"permit: seconds is {seconds}, must be >= 0 and finite")
        return self._request({"verb": "permit", "duration_s": float(seconds)})

    @front_door
    def sample(
        self,
        *,
        n: int = 0,
        retry: bool = False,
        detach: bool = False,
        inputs: str | Path | None = None,
        progress: Callback | bool | None = None,
    ) -> Answer:
        """One sampling campaign; returns when its gap is there.

        n: samples, fixed beforehand (0: what the profile or its beta needs). retry: repeat it once if its samples depend on each other.
        detach: return when the daemon drives. inputs: drive this file of inputs instead, which founds no gap.
        """
        check_counts(n=n)
        return self._request(sample_request(n=n, retry=retry, detach=detach, inputs=None if inputs is None else Path(inputs)), progress)

    def pause(self) -> Answer:
        """Stops the campaign and keeps it; `sample` goes on with it."""
        return self._request({"verb": "pause"})

    def cancel(self) -> Answer:
        """Stops the campaign and gives it up. Its share of beta is spent."""
        return self._request({"verb": "cancel"})

    @front_door
    def deploy(
        self,
        controller: str | Path,
        *,
        certificate: str | Path | None = None,
        param: Mapping[str, float] | None = None,
        progress: Callback | bool | None = None,
    ) -> Answer:
        """Lets a controller drive if a certificate covers it; verifies it first if none does. `ok` is False if it was refused.

        It drives on after this call: `undeploy` ends that, `stop` is the emergency stop.
        """
        check_named_numbers(param=param)
        request = deploy_request(Path(controller), param or {}, None if certificate is None else Path(certificate))
        return self._request(request, progress)

    def undeploy(self) -> Answer:
        """Ends the deployment; the recovery controller stops the robot."""
        return self._request({"verb": "undeploy"})

    def stop(self) -> Answer:
        """Emergency stop; latches until `clear("emergency_stop")`."""
        return self._request({"verb": "stop"})

    def clear(self, reason: str) -> Answer:
        """Clears a latched reason, after looking into it. reason: as `status()` has it, such as `emergency_stop`."""
        return self._request({"verb": "clear", "text": reason})

    def revoke(self, certificate: str = "") -> Answer:
        """Withdraws the certificate of this id, or all of them."""
        return self._request({"verb": "revoke", "text": certificate})

    @front_door
    def adopt(self, model: str | Path | None = None) -> Answer:
        """Uses this model file from now on (default: the one that tracing proposes). It voids the gap: a fresh campaign comes next."""
        return self._request(adopt_request(None if model is None else Path(model)))

    def trace(self, live: str = "campaign", *, progress: Callback | bool | None = None) -> Answer:
        """Traces what the daemon recorded: `campaign`, `drive` or `inputs`. `data` is what `s2r trace --live --json` prints."""
        return self._request({"verb": "trace", "text": live}, progress)

    def _request(self, request: dict[str, Any], progress: Callback | bool | None = False) -> Answer:
        try:
            answer = talk(self.socket, request, watcher_of(progress))
        except S2RError as error:
            error.args = (in_python(str(error)),)
            raise
        code, text = int(answer["exit_code"]), str(answer.get("text", ""))
        if code not in (0, REFUSED):
            raise _ERRORS.get(code, S2RError)(in_python(text))
        return Answer(code == 0, text, answer.get("data"))


@front_door
def connect(robot: str | None = None, *, socket: str | Path | None = None) -> Daemon:
    """The daemon that runs on this machine.

    robot: whose, if several daemons run here. socket: its control socket, if it is not in the usual place.
    Raises UsageError if no daemon answers, or if several do and none is chosen.
    """
    path = Path(socket) if socket is not None else control.find_socket(robot)
    if path is None or not path.exists():
        raise UsageError(f"{path}: no daemon listens there; start one: s2r run PROFILE")
    return Daemon(path)


def talk(socket: Path, request: dict[str, Any], watcher: Watcher, presence: control.Presence | None = None) -> dict[str, Any]:
    """Sends a request and returns its final answer: `exit_code`, `text`, `data`. Raises UsageError if nobody answers."""
    phase = watcher.phase(request["verb"]) if request["verb"] in WAITING else nullcontext(lambda *_: None)
    with phase as report:

        def on_progress(line: dict[str, Any]) -> None:
            if "done" in line and "total" in line:
                report(float(line["done"]), float(line["total"]), str(line.get("detail", "")), line.get("seconds_left"))
            elif line.get("text"):
                watcher.line(str(line["text"]))

        return control.call(socket, request, on_progress, presence)


def sample_request(*, n: int = 0, retry: bool = False, detach: bool = False, inputs: Path | None = None) -> dict[str, Any]:
    """A campaign, or given inputs. Raises UsageError."""
    if inputs and (n or retry):
        raise UsageError("--inputs: drives what is in the file; leave -n, --retry, --pause and --cancel out")
    if inputs and not inputs.is_file():
        raise UsageError(f"--inputs {inputs}: no such file; s2r trace --suggest writes one")
    request: dict[str, Any] = {"verb": "excite", "path": str(inputs.resolve())} if inputs else {"verb": "sample", "count": n}
    if detach:
        request["detached"] = True
    if retry:
        request["text"] = "retry"
    return request


def deploy_request(controller: Path, param: Mapping[str, float], certificate: Path | None) -> dict[str, Any]:
    """A controller's file, parameters and certificate. Raises UsageError for a file that cannot be read."""
    if not controller.exists():
        raise UsageError(
            f"{controller}: no such file; a controller is a Python file with control(x, theta, parameters), or a learned policy (.onnx)"
        )
    request: dict[str, Any] = {"verb": "deploy", "path": str(controller.resolve()), "parameters": dict(param)}
    if certificate:
        try:
            request["certificate"] = read_bounded(certificate).decode()
        except ConfigError as error:
            raise UsageError(str(error)) from None
        except UnicodeDecodeError:
            raise UsageError(f"{certificate}: is no certificate: not UTF-8 text") from None
    return request


def adopt_request(model: Path | None) -> dict[str, Any]:
    """A model's file, or the proposed one. Raises ConfigError."""
    from s2r_runtime.files.toml_text import read_text
    from s2r_runtime.modelspec import load_model

    if model is None:
        return {"verb": "adopt"}
    load_model(model)
    return {"verb": "adopt", "text": read_text(model), "base": str(model.resolve().parent)}
