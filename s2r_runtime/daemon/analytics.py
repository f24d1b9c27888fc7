"""The analytics process: observations and commands -> discrepancies and the watch's e-value, while a controller drives.

It has a process of its own because one busy Python thread costs the gate 5 ms at the median, and because numpy lives here and not
with the gate. Both ends are in this file: `Analytics` in the daemon (no numpy), `main` in the child. One JSON line a message, in
order; every `Observation` is answered by one `Reply`, so that the daemon can wait for it (lockstep) or miss it (a hang).
"""

from __future__ import annotations

import gc
import sys
import time
from collections.abc import Callable
from typing import TYPE_CHECKING

import msgspec

from s2r_runtime.child import Child, die_with_parent, say, stand_back, take_stdout
from s2r_runtime.daemon.settings import ModelFacts, facts_of
from s2r_runtime.errors import ConfigError, S2RError, one_line
from s2r_runtime.messages import Gap, Measured, Observation, Send
from s2r_runtime.modelspec import ModelSpec
from s2r_runtime.profile import Profile

if TYPE_CHECKING:
    from s2r_runtime.evidence.watch import Stream


class Setup(msgspec.Struct, frozen=True, tag="setup"):
    """First message: check this profile, and tell the facts of its model."""

    profile: Profile
    where: str


class Watching(msgspec.Struct, frozen=True, tag="watching"):
    """From here on measure against this gap of this model. alpha, run_length: bars of the watch's notices. The rest: where the watch of
    this epoch stood (a restart goes on there; see `messages.WatchStood`).
    """

    model: ModelSpec
    gap: Gap
    fault_jump: float
    n: int = 0
    exceedances: int = 0
    e_value: float | None = None
    change: float = 0.0
    exchange: float = 1.0
    counts: tuple[int, ...] = ()
    alpha: float = 0.01
    run_length: float = 1e5


class Ready(msgspec.Struct, frozen=True, tag="ready"):
    """The profile is sound."""

    facts: ModelFacts


class Refused(msgspec.Struct, frozen=True, tag="refused"):
    """The profile is not."""

    text: str


class Restarted(msgspec.Struct, frozen=True, tag="restarted"):
    """The robot started anew, or the link to it was lost or found."""


class Reply(msgspec.Struct, frozen=True, tag="reply"):
    """To an observation: what was measured with it, if a transition ended there. The child has no clock: t_ns is 0."""

    obs_seq: int
    measured: Measured | None


Downward = Setup | Watching | Observation | Send | Restarted
Upward = Ready | Refused | Reply

_ENCODE = msgspec.json.Encoder().encode
_DECODE_UP = msgspec.json.Decoder(Upward).decode


# ---------------------------------------------------------------- in the daemon


def start() -> Child:
    """The process alone, which loads its libraries and waits: half of the daemon's start, if it is begun before the other half."""
    return Child("s2r_runtime.daemon.analytics")


class Analytics:
    """The daemon's end. `poll` and `wait` give what came; `down` says why it is no more, or nothing.

    `late`: the watch is behind the robot by more than `machine.watch_delay`. A process that is silent for `machine.process_timeout` hangs,
    and is down.
    """

    def __init__(self, profile: Profile, where: str, child: Child | None = None, clock: Callable[[], int] = time.monotonic_ns) -> None:
        """child: the process, if it was started earlier (see `start`). clock: ns, of how long it is waited for."""
        self.down = ""
        self._child = child or start()
        self._clock, self._machine = clock, profile.machine
        self._waiting: dict[int, int] = {}  # observation -> when it was handed over, ns
        self._spoke_ns = clock()
        self._child.send(_ENCODE(Setup(profile, where)))

    @property
    def pid(self) -> int:
        """Process id."""
        return self._child.pid

    def fileno(self) -> int:
        """Readable when `poll` has something."""
        return self._child.fileno()

    def facts(self) -> ModelFacts:
        """Waits for the answer to the set-up. Raises ConfigError with what is wrong with the profile."""
        line = self._child.wait(self._machine.start_timeout)
        if line is None:
            raise ConfigError(f"the analytics process did not start: {self._child.ending()} (machine.start_timeout)")
        answer = _DECODE_UP(line)
        if isinstance(answer, Ready):
            return answer.facts
        raise ConfigError(answer.text if isinstance(answer, Refused) else "the analytics process is out of step")

    def watch(self, watching: Watching) -> None:
        """Begins to measure."""
        self._send(watching)

    def sent(self, send: Send) -> None:
        """The robot was told this. It goes with the next observation: alone it would only wake the process."""
        if not self.down:
            self._child.queue(_ENCODE(send))

    def restarted(self) -> None:
        """No transition spans this; it goes with the next observation."""
        if not self.down:
            self._child.queue(_ENCODE(Restarted()))

    def observed(self, observation: Observation) -> None:
        """The robot was seen there; a Reply comes."""
        now_ns = self._clock()
        if not self._waiting:
            self._spoke_ns = now_ns
        self._waiting.setdefault(observation.seq, now_ns)
        self._send(observation)

    @property
    def late(self) -> str:
        """By how much it is behind the robot, in words; empty while that is within `machine.watch_delay`."""
        behind_s = (self._clock() - next(iter(self._waiting.values()), self._clock())) * 1e-9
        allowed_s = self._machine.watch_delay
        return f"analytics is {behind_s:.1f} s behind the robot (machine.watch_delay is {allowed_s:g} s)" if behind_s > allowed_s else ""

    def wait(self) -> list[Upward]:
        """As `poll`, once every observation has its reply; or it is down."""
        came: list[Upward] = []
        deadline = time.monotonic() + self._machine.process_timeout
        while self._waiting and not self.down:
            line = self._child.wait(deadline - time.monotonic())
            if line is None:
                self.down = f"analytics: {self._child.ending()}"
                break
            came += self._taken(line)
        return came

    def poll(self) -> list[Upward]:
        """What came since the last call; notices a process that died or hangs."""
        if self.down:
            return []
        self._child.retry()
        came = [message for line in self._child.lines() for message in self._taken(line)]
        silent_ns = self._clock() - self._spoke_ns if self._waiting else 0
        if not self._child.alive() or silent_ns > self._machine.process_timeout * 1e9:
            self.down = f"analytics: {self._child.ending()}"
        return came

    def stop(self) -> None:
        """Ends the process; may be called twice."""
        self.down = self.down or "stopped"
        self._child.stop()

    def _send(self, message: Downward) -> None:
        if not self.down:
            self._child.send(_ENCODE(message))

    def _taken(self, line: bytes) -> list[Upward]:
        try:
            message = _DECODE_UP(line)
        except msgspec.DecodeError as error:
            self.down = f"analytics is out of step: {error}"
            return []
        self._spoke_ns = self._clock()
        if isinstance(message, Reply):
            self._waiting.pop(message.obs_seq, None)
        return [message]


# ---------------------------------------------------------------- in the child


def main(arguments: list[str]) -> int:
    """Reads messages from stdin until it closes."""
    die_with_parent(int(arguments[0]))
    stand_back(2)  # behind the gate, and behind the controller whose answer it waits for
    channel = take_stdout()
    from s2r_runtime.models import composed  # noqa: F401 - loaded before there is anything to do

    decode = msgspec.json.Decoder(Downward).decode
    stream: Stream | None = None
    epoch = 0
    for line in sys.stdin.buffer:
        message = decode(line)
        if isinstance(message, Observation):
            measured = stream.observed(message) if stream is not None else None
            if measured is not None:
                measured = msgspec.structs.replace(measured, epoch=epoch)
            say(channel, _ENCODE(Reply(message.seq, measured)))
        elif isinstance(message, Send):
            if stream is not None:
                stream.sent(message)
        elif isinstance(message, Restarted):
            if stream is not None:
                stream.restarted()
        elif isinstance(message, Watching):
            stream, epoch = _stream(message), message.gap.epoch
            gc.collect()
            gc.freeze()  # what a step leaves behind is little; it need not be looked for among all that stays
        else:
            say(channel, _ENCODE(_checked(message)))
    return 0


def _checked(message: Setup) -> Ready | Refused:
    from s2r_runtime.plugins import registry
    from s2r_runtime.profile import check_model

    profile = message.profile
    try:
        model = check_model(profile, message.where)
        task = registry().get("tasks", profile.task.name)(profile.task.parameters, model.nominal, model.dt)
    except S2RError as error:
        return Refused(one_line(str(error), 2000))
    return Ready(facts_of(model, task.horizon))


def _stream(watching: Watching) -> Stream:
    from s2r_runtime.evidence.watch import Stream
    from s2r_runtime.models.composed import compose

    return Stream(
        compose(watching.model),
        watching.gap,
        fault_jump=watching.fault_jump,
        n=watching.n,
        exceedances=watching.exceedances,
        e_value=watching.e_value,
        change=watching.change,
        exchange=watching.exchange,
        counts=watching.counts,
        alpha=watching.alpha,
        run_length=watching.run_length,
    )


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
