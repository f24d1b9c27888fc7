"""The worker process: one job, one process. It gets the job as a JSON line, tells its progress, and ends with a result or an error.

Both ends are in this file: `Worker` in the daemon (no numpy), `main` in the child; what the jobs do is in `jobs`. A job is a pure
function of its message: all that it depends on is in there, the seed too.
"""

from __future__ import annotations

import contextlib
import signal
import sys
import time
import traceback
from typing import Any

import msgspec

from s2r_runtime.child import Child, die_with_parent, say, stand_back, take_stdout
from s2r_runtime.controllers.candidates import Synthesis
from s2r_runtime.controllers.file import ControllerFile
from s2r_runtime.controllers.processor import family, used
from s2r_runtime.daemon.given_inputs import GivenInputs
from s2r_runtime.daemon.settings import ModelFacts
from s2r_runtime.errors import S2RError, one_line
from s2r_runtime.evidence.logged_scenarios import LoggedScenario, SimulatedScores
from s2r_runtime.files.printable import printable_lines
from s2r_runtime.messages import CertificateFacts, Gap, SampleTaken, Stretch, Verification
from s2r_runtime.modelspec import COMPACT, ModelSpec
from s2r_runtime.profile import Profile
from s2r_runtime.recording.stretches import Cut

SAID_MAX = 2000
"""Characters of an error: those of a certificate that is refused list all that is wrong with it."""


class GapJob(msgspec.Struct, frozen=True, tag="gap"):
    """Bound the gap of the profile's model on a campaign's samples. beta: what the epoch spends, on both radii together."""

    profile: Profile
    samples: tuple[SampleTaken, ...]
    rejected: dict[str, int]
    epoch: int
    beta: float


class LoadJob(msgspec.Struct, frozen=True, tag="load"):
    """Read a controller's file and what it imports; and a certificate for it, if one came along. In a worker, because a path may be slow,
    or a pipe, and a text anything. parameters, certificate: JSON, as it came. keys: whose signature counts. now_unix_s: the daemon's.
    """

    path: str
    parameters: msgspec.Raw = msgspec.Raw(b"{}")
    certificate: msgspec.Raw = msgspec.Raw(b'""')
    keys: tuple[bytes, ...] = ()
    profile: Profile | None = None
    now_unix_s: int = 0


class ModelJob(msgspec.Struct, frozen=True, tag="model"):
    """Read a model that is to take the place of the profile's, check that it is of the same robot (`facts`), and keep it in `folder`.

    base: as in `ModelStore`. text: a JSON string, its TOML, as it came; relative files are looked up from `where`. digest: of the
    proposed model instead, if there is no text.
    """

    profile: Profile
    facts: ModelFacts
    folder: str
    base: str
    text: msgspec.Raw = msgspec.Raw(b'""')
    where: str = ""
    digest: str = ""


class VerifyJob(msgspec.Struct, frozen=True, tag="verify"):
    """Roll the controller out on the uncertain model. gap: whose set and norm. least_radius: as in `StartJob`."""

    profile: Profile
    controller: ControllerFile
    gap: Gap
    radius: float
    hold_radius: float
    attempt: int
    seed: int
    beta: float
    least_radius: float = 0.0


class TraceJob(msgspec.Struct, frozen=True, tag="trace"):
    """Trace the residual of the profile's model in a stretch, its newest `rows` observations.

    In the daemon it is cut out of `logs`, before the order `job_id` of `run`; an audit gives the rows, and what stands for their logs. out:
    folder of the repaired model, `base` as in `ModelStore`; empty: it is not written. cpu_s: processor time after which it is given up
    (0: never).
    """

    profile: Profile
    stretch: Stretch
    epoch: int
    rows: int
    seed: int
    logs: tuple[str, ...] = ()
    run: str = ""
    job_id: int = 0
    cut: Cut | None = None
    identities: tuple[str, ...] = ()
    out: str = ""
    base: str = ""
    cpu_s: float = 0.0
    row_sketch: str = COMPACT
    """In which form the model remembers the rows that it was fitted on; empty: not, as in an audit of a log from before."""


class InputsJob(msgspec.Struct, frozen=True, tag="inputs"):
    """Read given inputs, and look whether they may be driven from where the robot is. x: (nx,), or empty if that isn't known."""

    path: str
    profile: Profile
    x: tuple[float, ...]


class SynthesisJob(msgspec.Struct, frozen=True, tag="synthesis"):
    """Search the controller's parameters within bounds, on the uncertain model, under the profile's required laws (offline only)."""

    profile: Profile
    controller: ControllerFile
    bounds: dict[str, tuple[float, float]]
    gap: Gap
    radius: float
    hold_radius: float
    evaluations: int
    scenarios: int
    number: int


class SimulateJob(msgspec.Struct, frozen=True, tag="simulate"):
    """Roll a controller out in the scenarios of logged runs, and in fresh ones from their starts (offline only). score: `trials.SCORES`."""

    profile: Profile
    controller: ControllerFile
    gap: Gap
    radius: float
    hold_radius: float
    law: str
    scenarios: tuple[LoggedScenario, ...]
    score: str
    rollouts: int
    seed: int


class EncloseJob(msgspec.Struct, frozen=True, tag="enclose"):
    """Compare n scenarios with a tube around the controller's nominal runs (offline only). rate: as in `tube_for`."""

    profile: Profile
    controller: ControllerFile
    gap: Gap
    radius: float
    hold_radius: float
    rate: float
    n: int
    seed: int


class Brought(msgspec.Struct, frozen=True):
    """A certificate that a person brought: what the core is to know of it, or `problem`. signer: the key that stands in it.
    untrusted: nothing but its key is wrong.
    """

    signer: bytes = b""
    text: str = ""
    facts: CertificateFacts | None = None
    gap: Gap | None = None
    problem: str = ""
    untrusted: bool = False


class Model(msgspec.Struct, frozen=True):
    """A model that can take the place of the profile's, and is kept. toml: its text."""

    spec: ModelSpec
    digest: str
    facts: ModelFacts
    toml: str


Job = LoadJob | ModelJob | GapJob | VerifyJob | TraceJob | InputsJob | SynthesisJob | SimulateJob | EncloseJob


class EnclosedCounts(msgspec.Struct, frozen=True):
    """Of an EncloseJob's scenarios: those that are not enclosed, the tube's reach that was compared, m, the largest rate that was drawn."""

    failed: int
    reach: float
    rate_seen: float


class Progress(msgspec.Struct, frozen=True, tag="progress"):
    """done of total, and what is being done."""

    done: float
    total: float
    detail: str = ""


class Result(msgspec.Struct, frozen=True, tag="result"):
    """What a job found: the fields of JobFinished that it fills, or what was loaded."""

    gap: Gap | None = None
    verification: Verification | None = None
    trace: dict[str, Any] | None = None
    safety: dict[str, list[float]] = {}
    behaviour: str = ""
    controller: ControllerFile | None = None
    certificate: Brought | None = None
    model: Model | None = None
    inputs: GivenInputs | None = None
    synthesis: Synthesis | None = None
    simulated: SimulatedScores | None = None
    enclosed: EnclosedCounts | None = None


class Failed(msgspec.Struct, frozen=True, tag="failed"):
    """Why a job has no result, in one line."""

    text: str


Upward = Progress | Result | Failed

_ENCODE = msgspec.json.Encoder().encode
_DECODE_UP = msgspec.json.Decoder(Upward).decode


class Worker:
    """The daemon's end. `poll` gives progress and, last, a Result or Failed: always one of them, whatever happens to the process.

    timeout_s: of its time. What it waits for a processor is not, as far as the kernel counts it, nor what it is paused for.
    """

    def __init__(self, job: Job, timeout_s: float) -> None:
        self._child = Child("s2r_runtime.daemon.worker")
        self._deadline_ns = time.monotonic_ns() + round(timeout_s * 1e9)
        setting = {VerifyJob: " (verification.timeout)", TraceJob: " (repair.timeout)"}.get(type(job), "")
        self._overdue = f"not done within {timeout_s:g} s{setting}"
        self._paused_ns: int | None = None
        self._waited: dict[int, int] = {}
        self._child.send(_ENCODE(job))

    @property
    def pid(self) -> int:
        """Process id."""
        return self._child.pid

    def fileno(self) -> int:
        """Readable when `poll` has something."""
        return self._child.fileno()

    def poll(self, now_ns: int) -> list[Upward]:
        """What came since the last call, and the end where it died or its time is over. Call at least every second."""
        self._child.retry()
        came: list[Upward] = []
        for line in self._child.lines():
            try:
                came.append(_DECODE_UP(line))
            except msgspec.DecodeError as error:
                came.append(Failed(f"the worker is out of step: {error}"))
            if not isinstance(came[-1], Progress):
                return came
        if not self._child.alive():
            came.append(Failed(f"the worker died: {self._child.ending()}"))
        elif self._paused_ns is None and now_ns > self._deadline_ns:
            self._deadline_ns += self._kept_waiting_ns()
            if now_ns > self._deadline_ns:
                came.append(Failed(self._overdue))
        return came

    def _kept_waiting_ns(self) -> int:
        """For how long it, or the controller's process that it waits for, has waited for a processor since the last call."""
        more = 0
        for pid in family(self._child.pid):
            if (found := used(pid)) is not None:
                more += found.waited_ns - self._waited.get(pid, 0)
                self._waited[pid] = found.waited_ns
        return more

    def pause(self, now_ns: int) -> None:
        """Others go first: the process stands still, and its time with it. May be called twice."""
        if self._paused_ns is None:
            self._paused_ns = now_ns
            self._child.signal(signal.SIGSTOP)

    def resume(self, now_ns: int) -> None:
        """Goes on."""
        if self._paused_ns is not None:
            self._deadline_ns += now_ns - self._paused_ns
            self._paused_ns = None
            self._child.signal(signal.SIGCONT)

    def stop(self) -> None:
        """Ends the process; may be called twice."""
        self._child.stop()


def main(arguments: list[str]) -> int:
    """Does the one job on stdin."""
    die_with_parent(int(arguments[0]))
    stand_back(None)  # a verification computes for minutes
    channel = take_stdout()
    spoken = 0.0

    def progress(done: float, total: float, detail: str = "") -> None:
        nonlocal spoken
        if time.monotonic() - spoken > 0.1:
            spoken = time.monotonic()
            say(channel, _ENCODE(Progress(done, total, detail)))

    try:
        job = msgspec.json.decode(sys.stdin.buffer.readline(), type=Job)
        from s2r_runtime.daemon.jobs import run

        line = _ENCODE(run(job, progress))
    except S2RError as error:
        line = _ENCODE(Failed(one_line(str(error), SAID_MAX)))
    except Exception as error:  # noqa: BLE001 - whatever a job raises is its result; a verification that failed to run is a refusal
        with contextlib.suppress(OSError):  # confined, it may not write to a file
            sys.stderr.write(printable_lines(traceback.format_exc()))
        line = _ENCODE(Failed(one_line(f"{type(error).__name__}: {error}", SAID_MAX)))
    say(channel, line)
    return 0


if __name__ == "__main__":
    from s2r_runtime.daemon.worker import main as once  # `jobs` imports this module, and its structs must be the same ones

    raise SystemExit(once(sys.argv[1:]))
