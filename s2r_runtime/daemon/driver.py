"""The source `controller` inside the daemon: the hosted process's answers and its end, as events for the core."""

from __future__ import annotations

import selectors
import time
from collections.abc import Callable

from s2r_runtime.controllers.episodes import Episode, end_report, score_report
from s2r_runtime.controllers.file import ControllerFile
from s2r_runtime.controllers.hosted import HostedController, Late, Ready, Reply, Stopped
from s2r_runtime.daemon.awake import AwakeClock
from s2r_runtime.daemon.settings import controller_deadline_s
from s2r_runtime.errors import ControllerError
from s2r_runtime.messages import (
    AnswerLate,
    Command,
    Event,
    Observation,
    Proposed,
    Scenarios,
    Settings,
    SourceStarted,
    SourceStopped,
)
from s2r_runtime.profile import Profile


class Driver:
    """At most one controller at a time. Events come through `emit`, their time from `now`."""

    def __init__(
        self,
        selector: selectors.BaseSelector,
        profile: Profile,
        settings: Callable[[], Settings],
        emit: Callable[[Event], None],
        now: Callable[[], int],
        next_seq: Callable[[], int],
        awake: AwakeClock,
    ) -> None:
        """settings: those in force. next_seq: numbers the commands of all sources. awake: knows for how long the daemon stood still."""
        self._selector, self._profile, self._settings = selector, profile, settings
        self._emit, self._now, self._next_seq = emit, now, next_seq
        self._host: HostedController | None = None
        self._awake, self._stood_still_ns = awake, 0
        self._deadline_ns = round(1e9 * controller_deadline_s(profile))
        self._patience_s = 0.0 if profile.clock == "lockstep" else profile.machine.process_timeout
        self.latency_ns = 0
        self._contained: tuple[str, ...] = ()
        self._scored: tuple[int, bool] = (-1, False)

    @property
    def running(self) -> bool:
        """Whether there is a controller's process."""
        return self._host is not None

    @property
    def pid(self) -> int:
        """Its process id, or 0."""
        return self._host.pid if self._host is not None else 0

    @property
    def contained(self) -> tuple[str, ...]:
        """What is in force in its process (see `confinement.confine`); nothing while there is none."""
        return self._contained if self._host is not None else ()

    @property
    def due_ns(self) -> int | None:
        """When `poll` must be called at the latest (host's clock)."""
        return self._host.deadline_ns if self._host is not None else None

    def start(self, file: ControllerFile, scenarios: Scenarios) -> None:
        """Starts the process; SourceStarted or SourceStopped(start_failed) follows."""
        self.stop()
        self._stood_still_ns, self._scored = self._awake.stood_still_ns, (-1, False)
        settings = self._settings()
        host = HostedController(
            file,
            model=self._profile.model,
            nx=len(settings.states),
            nu=len(settings.inputs),
            task=self._profile.task,
            scenarios=scenarios,
            start_timeout_s=self._profile.machine.start_timeout,
            patience_s=self._patience_s,
        )
        try:
            host.start()
        except ControllerError as error:
            host.close()
            self._emit(SourceStopped(self._now(), "controller", "start_failed", str(error)))
            return
        self._host = host
        self._selector.register(host, selectors.EVENT_READ, lambda _: self.poll(time.monotonic_ns()))

    def use(self, profile: Profile) -> None:
        """The profile with another model from here on."""
        self._profile = profile

    def ask(self, observation: Observation) -> None:
        """Asks what to do about it; Proposed or SourceStopped follows."""
        if self._host is None:
            return
        self._forgive_pause()
        try:
            self._host.ask(observation, time.monotonic_ns() + self._deadline_ns)
        except ValueError as error:
            self._end(SourceStopped(self._now(), "controller", "raised", str(error)))

    def poll(self, now_ns: int) -> None:
        """Takes what came. now_ns: the host's clock."""
        if self._host is None:
            return
        self._forgive_pause()
        for message in self._host.poll(now_ns):
            t_ns = self._now()
            if isinstance(message, Reply):
                self.latency_ns = message.latency_ns
                self._episode(t_ns, message.ended)
                if self._host is not None:
                    self._score(t_ns, message.episode)
                if message.late or self._host is None:
                    continue  # its question is void
                ttl_ns = self._settings().command_ttl_ns
                self._emit(Proposed(t_ns, Command(self._next_seq(), t_ns, "controller", message.u, message.obs_seq, ttl_ns)))
            elif isinstance(message, Late):
                self._emit(AnswerLate(t_ns, message.obs_seq, message.detail))
            elif isinstance(message, Stopped):
                self._episode(t_ns, message.ended)
                self._end(SourceStopped(t_ns, "controller", message.reason, message.detail))
            elif isinstance(message, Ready):
                self._contained = message.contained
                self._emit(SourceStarted(t_ns, "controller", message.digest))
            if self._host is None:  # what an answer led to has stopped it
                return

    def stop(self) -> None:
        """Kills it; no event follows. May be called twice."""
        if self._host is not None:
            host, self._host = self._host, None
            self._selector.unregister(host)
            host.close()

    def _forgive_pause(self) -> None:
        """While the daemon stood still the controller may have, too: such time is not its fault. How old its answer is, the gate sees."""
        paused_ns, self._stood_still_ns = self._awake.stood_still_ns - self._stood_still_ns, self._awake.stood_still_ns
        if paused_ns and self._host is not None:
            self._host.forgive(paused_ns)

    def _end(self, event: SourceStopped) -> None:
        self.stop()
        self._emit(event)

    def _episode(self, t_ns: int, ended: Episode | None) -> None:
        if ended is not None:
            self._emit(end_report(t_ns, ended))

    def _score(self, t_ns: int, now: Episode | None) -> None:
        if now is not None:
            self._scored, report = score_report(t_ns, now, self._scored, self._profile.verification.threshold)
            if report is not None:
                self._emit(report)
