"""Between daemon and controller: `python -m s2r_runtime.controllers.hosting DESCRIPTOR PARENT_PID`, started by `HostedController`.

It draws the scenarios, and asks the controller's own process (`batches`), which is of the same kind as in a verification. One JSON line a
message over the socket that it was given; what the controller prints goes to this process's pipe.

    parent: Package                    the bytes to run, the task, the seed
    child:  Loaded(digest)             of the bytes it received, on the versions it has, before any of them ran
    child:  Up(contained, pid)         the controller's process is confined and its module has run
    parent: Question(obs_seq, x)       child: Chosen(obs_seq, u, ...)      and so on
    child:  Ended(reason, detail)      the last message: raised, malformed, finished
"""

from __future__ import annotations

import faulthandler
import gc
import select
import socket
import sys
from typing import TYPE_CHECKING, BinaryIO, Literal

import msgspec

from s2r_runtime.controllers.episodes import Episode, Episodes
from s2r_runtime.controllers.file import ControllerFile
from s2r_runtime.messages import Scenarios
from s2r_runtime.modelspec import ModelSpec
from s2r_runtime.profile import TaskChoice

if TYPE_CHECKING:
    from s2r_runtime.controllers.batches import BatchController
    from s2r_runtime.controllers.code import Control
    from s2r_runtime.controllers.observing import View


class _Message(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Base of what goes over the socket."""


class Package(_Message, frozen=True):
    """Everything the child needs. task None: the controller sees an empty `theta`."""

    file: ControllerFile
    model: ModelSpec
    nu: int
    task: TaskChoice | None
    scenarios: Scenarios
    memory_bytes: int


class Question(_Message, frozen=True):
    """What to do at x (nx,)?"""

    obs_seq: int
    x: tuple[float, ...]


class Loaded(_Message, frozen=True, tag="loaded"):
    """Digest of what is about to run."""

    digest: str


class Up(_Message, frozen=True, tag="up"):
    """Ready for questions. contained: see `confinement.confine`. pid: of the controller's process."""

    contained: tuple[str, ...]
    pid: int


class Chosen(_Message, frozen=True, tag="chosen"):
    """The answer: u (nu,). episode: where the scenario stands; ended: the one that ended with this observation."""

    obs_seq: int
    u: tuple[float, ...]
    episode: Episode | None
    ended: Episode | None


class Ended(_Message, frozen=True, tag="ended"):
    """No more answers."""

    reason: Literal["raised", "malformed", "died", "inconsistent", "finished"]
    detail: str
    ended: Episode | None = None


Message = Loaded | Up | Chosen | Ended


def main(arguments: list[str]) -> int:
    """The child's life. Returns the exit code."""
    from s2r_runtime.child import die_with_parent, stand_back

    descriptor, parent = (int(text) for text in arguments)
    die_with_parent(parent)
    stand_back(1)  # one that computes without end keeps nobody from the gate
    faulthandler.enable()
    channel = socket.socket(fileno=descriptor)
    lines = channel.makefile("rb")
    try:
        _send(channel, _host(channel, lines))
    except (BrokenPipeError, ConnectionResetError):
        return 1  # the daemon is gone, and this process with it
    return 0


def _send(channel: socket.socket, message: Message) -> None:
    channel.sendall(msgspec.json.encode(message) + b"\n")


def _host(channel: socket.socket, lines: BinaryIO) -> Ended:
    """Loads, confines, and answers until there is a reason to end."""
    from s2r_runtime.controllers.asked_again import AskedAgain, Inconsistent
    from s2r_runtime.controllers.batches import MEMORY_BYTES, BatchController, Died
    from s2r_runtime.controllers.code import Malformed
    from s2r_runtime.controllers.observing import view_of, whole
    from s2r_runtime.controllers.policy import is_policy
    from s2r_runtime.errors import S2RError
    from s2r_runtime.models.composed import compose

    package = msgspec.json.decode(lines.readline(), type=Package)
    _send(channel, Loaded(package.file.as_found_here().digest))
    try:
        episodes = _episodes(package)
        view = view_of(package.file, compose(package.model)) if is_policy(package.file.entry) else whole
        memory_bytes = package.memory_bytes or MEMORY_BYTES
        with (
            BatchController(package.file, package.nu, memory_bytes, printed=1) as control,
            BatchController(package.file, package.nu, memory_bytes) as witness,
        ):
            asked = AskedAgain(control, witness)
            gc.collect()
            gc.freeze()  # what is there now stays; collections while driving have little to look at
            _send(channel, Up(control.contained, control.pid))
            while line := _question(channel, lines, control):
                answer = _answer(msgspec.json.decode(line, type=Question), episodes, view, asked)
                if isinstance(answer, Ended):
                    return answer
                _send(channel, answer)
                asked.check()
    except Inconsistent as error:
        return Ended("inconsistent", str(error))
    except Died as error:
        return Ended("died", error.how)
    except Malformed as error:
        return Ended("malformed", str(error))
    except S2RError as error:
        return Ended("raised", str(error))
    return Ended("finished", "no more questions")


def _question(channel: socket.socket, lines: BinaryIO, control: BatchController) -> bytes:
    """The next line; empty where there is none any more. Raises ControllerError if the controller's process ends, or speaks, unasked."""
    ready = select.select([channel.fileno(), control.fileno()], [], [])[0]
    if channel.fileno() not in ready:
        control.spoke_unasked()
    return lines.readline()


def _episodes(package: Package) -> Episodes | None:
    from s2r_runtime.models.composed import compose
    from s2r_runtime.plugins import registry

    if package.task is None:
        return None
    model = compose(package.model)
    task = registry().get("tasks", package.task.name)(package.task.parameters, model.nominal, package.model.dt)
    return Episodes.of(task, package.scenarios)


def _answer(question: Question, episodes: Episodes | None, view: View, control: Control) -> Chosen | Ended:
    import numpy as np

    theta, episode, ended = {}, None, None
    if episodes is not None:
        try:
            seen, episode, ended = episodes.look(np.array(question.x))
        except Exception as error:  # noqa: BLE001 - a third party's task: what it raises ends this drive, with its name
            return Ended("raised", f"task: {type(error).__name__}: {error}")
        if seen is None:
            return Ended("finished", f"all {episode.index + 1} scenarios are over", ended)
        theta = seen
    x = np.array([question.x])
    u = control(x, view(x, theta, first=episode is not None and episode.k == 0))
    return Chosen(question.obs_seq, tuple(u[0].tolist()), episode, ended)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
