"""Loads controllers, and hosts one in a process of its own, for the daemon: nothing here ever waits.

    host = HostedController(file, model=..., nx=3, nu=2, task=..., scenarios=Scenarios(seed=1, first=0, count=0))
    host.start()                       -> Ready(digest) or Stopped(...) from a later `poll`
    host.ask(observation, deadline)    -> Reply(obs_seq, u, ...) or Stopped(...) from a later `poll`

The child is not trusted. It gets the bytes that were digested, one question at a time, and a deadline for each; whatever else
than an answer in time comes from it (an error, a malformed line, an answer to nothing, silence, its end) is a
`Stopped` with the reason, and its whole process group is killed. What it can't do meanwhile stands in `confinement`.

An answer that is late for a reason of the computer's is no fault of the controller: it waited for a processor, or the daemon stood
still. Then `Late` comes at the deadline, and the answer when it is there, marked as late. `patience_s` bounds that.
"""

from __future__ import annotations

import math
import time
from typing import TYPE_CHECKING, Literal, NamedTuple

import msgspec

from s2r_runtime.controllers.confined_process import ConfinedProcess
from s2r_runtime.controllers.episodes import Episode
from s2r_runtime.controllers.file import ControllerFile, Identity, load
from s2r_runtime.controllers.hosting import Chosen, Ended, Loaded, Message, Package, Question, Up
from s2r_runtime.controllers.processor import Used, used
from s2r_runtime.errors import ControllerError, one_line
from s2r_runtime.messages import Observation, Scenarios
from s2r_runtime.modelspec import ModelSpec
from s2r_runtime.profile import TaskChoice

if TYPE_CHECKING:
    from s2r_runtime.controllers.code import Control

__all__ = ["ControllerFile", "HostedController", "Identity", "Ready", "Reply", "Stopped", "batch_control", "load"]

DETAIL_MAX = 400
"""Characters of the child's own account that are passed on."""
START_TIMEOUT_S = 30.0
"""Importing numerical libraries takes seconds on a small computer with a cold disk."""

Reason = Literal["finished", "raised", "died", "deadline", "malformed", "inconsistent", "start_failed"]


class Ready(NamedTuple):
    """It can be asked. digest: of what runs there. contained: see `confinement.confine`."""

    digest: str
    contained: tuple[str, ...]


class Reply(NamedTuple):
    """What it wants to do, u (nu,), finite. `latency_ns`: from `ask` until it was read. `late`: after a `Late`. The rest is its word."""

    obs_seq: int
    u: tuple[float, ...]
    episode: Episode | None
    ended: Episode | None
    latency_ns: int
    late: bool = False


class Late(NamedTuple):
    """It did not answer in time, and could not. detail: why."""

    obs_seq: int
    detail: str


class Stopped(NamedTuple):
    """It is gone; nothing comes after this. ended: the scenario that ended with the last one, if it finished."""

    reason: Reason
    detail: str
    ended: Episode | None = None


class _Asked(NamedTuple):
    """used: what the process had had of the processor when it was asked. forgiven_ns: for how long the daemon has stood still since."""

    question: Question
    deadline_ns: int
    asked_ns: int
    used: Used | None = None
    forgiven_ns: int = 0
    late: bool = False


_DECODER = msgspec.json.Decoder(Message)


def _excuse(pid: int, asked: _Asked, passed_ns: int, allowed_ns: int) -> str:
    """Why it is not the controller's fault that it has not answered yet; empty if it is. passed_ns: while the daemon was awake."""
    if passed_ns <= allowed_ns:
        return f"the daemon stood still for {asked.forgiven_ns / 1e6:.0f} ms"
    before, now = asked.used, used(pid)
    if before is None or now is None:
        return ""
    ran_ns, waited_ns = now.ran_ns - before.ran_ns, now.waited_ns - before.waited_ns
    spent_ns = ran_ns if now.ready else passed_ns - waited_ns
    return f"its process had the processor for {ran_ns / 1e6:.0f} ms of these" if spent_ns <= allowed_ns else ""


def batch_control(file: ControllerFile, nu: int | None = None) -> Control:
    """`control(x, theta) -> u` in this process, on the digested bytes (see `controller_code`). Imports numpy."""
    from s2r_runtime.controllers.code import batch_control as batched

    return batched(file, nu)


class HostedController:
    """One controller in one child process, from `start` to `close`. Not restarted: another start is another object."""

    def __init__(
        self,
        file: ControllerFile,
        *,
        model: ModelSpec,
        nx: int,
        nu: int,
        task: TaskChoice | None,
        scenarios: Scenarios,
        memory_bytes: int = 0,
        start_timeout_s: float = START_TIMEOUT_S,
        patience_s: float = 0.0,
    ) -> None:
        """scenarios: count 0: no end.

        memory_bytes: what it may allocate (0: as in a verification). patience_s: how long an answer may take in all where the computer
        is to blame; 0: its deadline, whoever is to blame.
        """
        self.file, self._nx, self._nu = file, nx, nu
        self._package = Package(file, model, nu, task, scenarios, memory_bytes)
        self._start_timeout_ns, self._patience_ns = round(start_timeout_s * 1e9), round(patience_s * 1e9)
        self._start_deadline_ns = 0
        self._process: ConfinedProcess | None = None
        self._running = False
        self._digest, self._ready, self._controller_pid = "", False, 0
        self._asked: _Asked | None = None
        self._waiting: _Asked | None = None

    def start(self) -> None:
        """Starts the process and hands it the bytes; `poll` says when it is ready. From the main thread, whose end is the child's.

        Raises ControllerError if no process can be started.
        """
        try:
            self._process = ConfinedProcess("s2r_runtime.controllers.hosting")
        except OSError as error:
            raise ControllerError(f"{self.file.path}: no process can be started for it: {error.strerror}") from None
        self._running = True
        self._start_deadline_ns = time.monotonic_ns() + self._start_timeout_ns
        self._process.send(msgspec.json.encode(self._package))

    def fileno(self) -> int:
        """Readable when `poll` has something to do. Valid from `start` to `close`; raises ValueError before."""
        return self._there().fileno()

    @property
    def pid(self) -> int:
        """The controller's process id; until it is ready, that of the process that starts it. Raises ValueError before `start`."""
        return self._controller_pid or self._there().pid

    @property
    def output(self) -> str:
        """The last that the controller printed, on stdout and stderr."""
        return self._process.output if self._process is not None else ""

    @property
    def deadline_ns(self) -> int | None:
        """When `poll` should be called at the latest, on the host's monotonic clock; None: nothing is awaited."""
        if not self._running:
            return None
        if not self._ready:
            return self._start_deadline_ns
        awaited = self._awaited()
        return None if awaited is None else self._due_ns(awaited)

    def ask(self, observation: Observation, deadline_ns: int) -> None:
        """Asks what to do about an observation; the answer must be there by then (host's monotonic clock).

        While it works on an earlier one this one waits, and takes the place of one that waits. After a `Stopped`
        nothing happens. Raises ValueError for a state that is not finite or not (nx,), or before it is ready.
        """
        if self._process is not None and not self._running:
            return
        if not self._ready:
            raise ValueError("the controller is not ready to be asked")
        if len(observation.x) != self._nx or not all(map(math.isfinite, observation.x)):
            raise ValueError(f"observation {observation.seq} has x {observation.x}, must be {self._nx} finite numbers")
        asked = _Asked(Question(observation.seq, observation.x), deadline_ns, time.monotonic_ns())
        if self._asked is not None:
            self._waiting = asked
        else:
            self._put(asked)

    def forgive(self, time_ns: int) -> None:
        """For so long whoever asks stood still: it is not held against the controller."""
        self._start_deadline_ns += time_ns
        if self._asked is not None:
            self._asked = self._asked._replace(forgiven_ns=self._asked.forgiven_ns + time_ns)
        if self._waiting is not None:
            self._waiting = self._waiting._replace(forgiven_ns=self._waiting.forgiven_ns + time_ns)

    def poll(self, now_ns: int) -> list[Ready | Reply | Late | Stopped]:
        """What happened since the last call. Call it when `fileno` is readable, at `deadline_ns`, and every 20 ms anyway.

        An answer that is there counts, also if this call comes after its deadline: the daemon was late then, and the gate
        judges how old it is.
        """
        if self._process is None:
            return []
        if not self._running:
            self._process.reap()
            return []
        found: list[Ready | Reply | Late | Stopped] = []
        lines, open_ = self._process.receive()
        for line in lines:
            if (event := self._take(line)) is not None:
                found.append(event)
            if isinstance(event, Stopped):
                break
        else:
            silent = self._silence(now_ns) if open_ else self._fault("died", self._process.ending())
            found += [silent] if silent is not None else []
        if found and isinstance(found[-1], Stopped):
            self.stop()
        return found

    def stop(self) -> None:
        """Kills the child and all of its process group, at once; no `Stopped` follows. May be called twice."""
        self._running = False
        if self._process is not None:
            self._process.kill()

    def close(self) -> None:
        """Stops it and frees everything, which takes milliseconds. May be called twice."""
        self._running = False
        if self._process is not None:
            self._process.close()

    def _there(self) -> ConfinedProcess:
        if self._process is None:
            raise ValueError("the controller was not started")
        return self._process

    def _put(self, asked: _Asked) -> None:
        self._asked, self._waiting = asked._replace(used=used(self.pid) if self._patience_ns else None), None
        self._there().send(msgspec.json.encode(asked.question))

    def _take(self, line: bytes) -> Ready | Reply | Stopped | None:
        try:
            message = _DECODER.decode(line)
        except (msgspec.DecodeError, UnicodeDecodeError, RecursionError):
            return self._fault("malformed", f"sent {line[:60]!r}, which is no answer")
        match message:
            case Loaded() if not self._digest:
                self._digest = message.digest
                return None
            case Up() if self._digest == self.file.digest and not self._ready:
                self._ready, self._controller_pid = True, message.pid
                return Ready(self._digest, message.contained)
            case Chosen() if self._asked is not None and message.obs_seq == self._asked.question.obs_seq:
                return self._reply(message, self._asked)
            case Ended():
                printed = self._there().last_printed() if message.reason == "died" else ""
                return self._fault(message.reason, one_line(message.detail + printed, DETAIL_MAX), message.ended)
        return self._fault("malformed", f"sent a message out of turn: {line[:60]!r}")

    def _reply(self, message: Chosen, asked: _Asked) -> Reply | Stopped:
        if len(message.u) != self._nu or not all(map(math.isfinite, message.u)):
            return self._fault("malformed", f"answered {message.u[:8]}, must be {self._nu} finite numbers")
        latency_ns = time.monotonic_ns() - asked.asked_ns
        self._asked = None
        if self._waiting is not None:
            self._put(self._waiting)
        return Reply(message.obs_seq, message.u, message.episode, message.ended, latency_ns, asked.late)

    def _silence(self, now_ns: int) -> Stopped | Late | None:
        if not self._ready and now_ns > self._start_deadline_ns:
            return self._fault("deadline", f"was not ready after {self._start_timeout_ns / 1e9:g} s")
        asked = self._asked
        if asked is None or now_ns <= self._due_ns(asked):
            return None
        allowed_ns, seq = asked.deadline_ns - asked.asked_ns, asked.question.obs_seq
        passed_ns = now_ns - asked.asked_ns - asked.forgiven_ns
        excuse = _excuse(self.pid, asked, passed_ns, allowed_ns) if self._patience_ns > max(passed_ns, allowed_ns) else ""
        if not excuse:
            return self._fault("deadline", f"did not answer observation {seq} within {allowed_ns / 1e6:.0f} ms")
        if not asked.late:
            self._asked = asked._replace(late=True)
        elif (waiting := self._waiting) is not None and now_ns > waiting.deadline_ns:
            self._waiting, seq = None, waiting.question.obs_seq
        else:
            return None
        return Late(seq, f"no answer to observation {seq} within {allowed_ns / 1e6:.0f} ms: {excuse}")

    def _awaited(self) -> _Asked | None:
        """The question whose deadline comes next."""
        return self._waiting if self._asked is not None and self._asked.late else self._asked

    def _due_ns(self, asked: _Asked) -> int:
        """When it is late. Who has no patience to lend waits for as long as it stood still itself."""
        return asked.deadline_ns + (0 if self._patience_ns else asked.forgiven_ns)

    def _fault(self, reason: Reason, detail: str, ended: Episode | None = None) -> Stopped:
        """Before it was ready every reason is a failed start."""
        return Stopped(reason, detail, ended) if self._ready else Stopped("start_failed", f"{reason}: {detail}")
