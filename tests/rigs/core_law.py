"""docs/gate.md written down once more, without the gate and without the core's state: what must never have happened.

`Law` sees nothing but events and outputs, made up or from a log. It is no rule for how the core goes about it, only for
what moves the robot. Angles are taken to be free, as they are in the profiles of these tests.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from fractions import Fraction

import msgspec
from core_rig import SETTINGS, S, of

from s2r_runtime import messages as m

DT = 100_000_000
WALK = msgspec.structs.replace(
    SETTINGS,
    dt_ns=DT,
    observation_timeout_ns=5 * DT,
    command_ttl_ns=2 * DT,
    hysteresis_ns=2 * DT + 1,
    settle_periods=3,
    epsilon=0.2,
    beta=0.5,
    max_measurement_faults=2,
    recovery="hold",
    recovery_input=(0.05, 5.0),
    required_laws=("uniform",),
)
STOPS = {"emergency_stop", "manual_override", "robot_twin", "observation_faults"}
FAULTS = ("raised", "died", "deadline", "malformed")


# ---------------------------------------------------------------- the law


@dataclass
class Law:
    """What docs/gate.md allows, from events and outputs alone. `judge` raises AssertionError for what must not have happened."""

    settings: m.Settings
    started: bool = False
    now: int = 0
    unix: tuple[int, int] = (0, 0)
    read: int = 0
    up: frozenset[str] = frozenset()
    latched: frozenset[str] = frozenset()
    model: str = ""
    gap: m.Gap | None = None
    radius: float = 0.0
    alarmed: bool = False
    stored: tuple[m.CertificateFacts, ...] = ()
    revoked: frozenset[str] = frozenset()
    running: str | None = None
    faults: int = 0
    permit: int | None = None
    sampling: bool = False
    inputs: str = ""
    campaign: int = 0
    latest: m.Observation | None = None
    good: m.Observation | None = None
    good_ns: int = -(10**18)
    odd: int | None = None
    anew: bool = False
    paused: bool = False
    usable: bool = False
    asked: m.Ask | None = None
    asked_ns: int = 0
    clear: int | None = None
    gate: bool = False
    instant: int | None = None
    instant_stamp: int | None = None
    origin: int = 0
    index: int = 0
    report: int = 0
    answered: bool = True
    last: m.Send | None = None
    refused: bool = False
    issuing: frozenset[int] = frozenset()
    epochs: int = 0
    attempts: int = 0
    requests: frozenset[int] = frozenset()
    final: frozenset[int] = frozenset()
    disk: m.Memory = field(default_factory=lambda: m.Memory("r", m.MEMORY_SCHEMA))

    def judge(self, event: m.Event, outputs: tuple[m.Output, ...]) -> None:
        """One event and what came of it."""
        if not self.started and not isinstance(event, m.Started):
            assert not of(list(outputs), m.Send)
            assert all(isinstance(output, m.Answer) for output in outputs)
            self._answers(event, outputs)
            return
        anew = event.t_ns < self.now or (isinstance(event, m.LinkChanged) and not event.up)
        if event.t_ns < self.now:
            self.permit = None
            self.unix = (self.unix[0], min(self.unix[1], event.t_ns))
        if anew:
            self._forget()
        idle = event.t_ns - self.now > self.settings.observation_timeout_ns and not self.settings.lockstep
        self.paused = idle and self.gate  # the gate closes on what was seen last, which answers what was asked, before this event counts
        self.now, self.refused, self.anew = event.t_ns, False, anew
        before = self._instant(event)
        self._facts(event, outputs)
        self._clear(event)
        self._sends(event, outputs, before)
        self._order(outputs)
        self._answers(event, outputs)
        self._clear(event)
        self.started = self.started and not isinstance(event, m.Stopping)
        self.last = None if anew else self.last  # what is waiting after this may wait where it waited before

    # ------------------------------------------------------------------ what is so

    def _facts(self, event: m.Event, outputs: tuple[m.Output, ...]) -> None:
        match event:
            case m.Started():
                self.started, self.settings = True, event.settings
                self.read = event.unix_s
                self.model, self.unix = event.settings.model_digest, (max(event.unix_s, event.memory.latest_unix_s), event.t_ns)
                self.up = frozenset({"recorder", "analytics"})
                self.running, self.sampling, self.permit, self.asked = None, False, None, None
                self.gate, self.answered, self.last = False, True, None
                self._forget()
            case m.WallClockRead():
                self.read, self.unix = event.unix_s, (max(event.unix_s, self._wall()), event.t_ns)
            case m.LinkChanged():
                self._up("link", event.up)
            case m.RecorderChanged():
                self._up("recorder", event.ok)
            case m.AnalyticsChanged():
                self._up("analytics", event.up)
            case m.OverrideChanged():
                self.latched |= {event.kind}
            case m.Measured():
                self._measured(event)
            case m.Observed():
                self._observed(event.observation)
            case m.SourceStopped(source="controller"):
                if self.running is not None and event.reason in FAULTS:
                    self.latched |= {"controller_fault"}
                self.running = None
            case m.SourceStopped(source="sampler") if event.reason != "finished":
                self.sampling = False
            case m.CampaignFinished() if not self.inputs and event.epoch == self.campaign:
                self.sampling = False
            case m.InputsFinished() if event.digest == self.inputs:
                self.sampling = False
            case m.SourceStarted(source="controller"):
                self.running, self.faults = event.digest, 0
            case m.SourceStarted(source="sampler"):
                self.sampling = True
            case m.CertificateStored() if event.gap is not None or event.request_id in self.issuing:
                self.stored = (*self.stored, event.facts)
            case m.CertificatesDistrusted():
                self.revoked |= {facts.id for facts in self.stored if facts.id in event.reasons}
            case m.Proposed():
                self._proposed(event.command, outputs)
            case m.AnswerLate():
                asked = self.asked
                self.refused = asked is not None and (asked.source, asked.obs_seq) == ("controller", event.obs_seq)
            case m.Requested():
                self._requested(event)
            case _:
                pass
        for output in outputs:
            match output:
                case m.EpochChanged(gap=gap) if gap is not None:
                    assert isinstance(event, m.JobFinished | m.CertificateStored)
                    assert event.gap == gap
                    self.gap, self.radius, self.alarmed = gap, gap.radius, False
                case m.ModelAdopted():
                    self.model, self.gap = output.digest, None
                case m.Revoked():
                    self.revoked |= {output.certificate_id}
                case m.StopController():
                    self.running = None
                case m.StopCampaign():
                    self.sampling = False
                case m.StartCampaign() | m.StartInputs():
                    self.inputs = output.digest if isinstance(output, m.StartInputs) else ""
                    self.campaign = 0 if isinstance(output, m.StartInputs) else output.epoch
                case m.IssueCertificate():
                    self.issuing |= {output.request_id}
                case _:
                    pass

    def _forget(self) -> None:
        """The robot's sequence begins anew."""
        self.usable, self.latest, self.good, self.odd, self.instant_stamp, self.report = False, None, None, None, None, 0

    def _up(self, what: str, up: bool) -> None:
        self.up = self.up | {what} if up else self.up - {what}

    def _measured(self, event: m.Measured) -> None:
        if self.gap is None or self.alarmed or event.epoch not in (0, self.gap.epoch):
            return
        told = all(math.isfinite(value) and value >= 0.0 for value in (event.e_value, event.change, event.exchange))
        counts = not event.fault and math.isfinite(event.discrepancy) and event.discrepancy >= 0.0
        self.faults += self.running is not None and not (told and counts)
        if not counts:
            return
        self.radius = max(self.radius, event.discrepancy)
        if told and event.e_value >= 1.0 / self.settings.alpha:
            self.alarmed = True
            self.latched |= {"watch_alarm"}
            self.revoked |= {facts.id for facts in self.stored if facts.epoch == self.gap.epoch}

    def _observed(self, seen: m.Observation) -> None:
        lockstep = self.settings.lockstep
        if seen == self.good:
            if lockstep:
                self.latest, self.usable = seen, True
            return
        valid = not seen.fault and len(seen.x) == 3 and all(map(math.isfinite, seen.x))
        if self.latest is not None and seen.seq == self.latest.seq and (self.usable or not lockstep or seen.fault):
            self.usable = self.usable and (valid or lockstep)
            return
        ordered = self.good is None or (seen.seq > self.good.seq and seen.stamp_ns > self.good.stamp_ns)
        again = seen.seq == self.odd if lockstep else self.now - self.good_ns > self.settings.observation_timeout_ns
        self.usable = valid and (ordered or again)
        if self.usable and not ordered:  # the robot started anew, and the grid with it
            self.instant_stamp, self.report = None, 0
            self._on_grid(seen.stamp_ns)
        if valid:
            self.odd = None if self.usable else seen.seq
        if self.usable or not valid:
            self.latest = seen
        if self.usable:
            self.good, self.good_ns = seen, self.now

    def _proposed(self, command: m.Command, outputs: tuple[m.Output, ...]) -> None:
        decided = of(list(outputs), m.Decided)
        assert len(decided) == 1
        asked = self.asked is not None and (self.asked.source, self.asked.obs_seq) == (command.source, command.obs_seq)
        broken = command.fault or len(command.u) != 2 or not all(map(math.isfinite, command.u))
        if command.source == "controller" and asked:
            self.refused = not decided[0].allow and decided[0].reason != "settling"
            if broken and decided[0].reason == "command_invalid":
                self.latched |= {"command_invalid"}

    def _requested(self, event: m.Requested) -> None:
        if event.verb == "stop":
            self.latched |= {"emergency_stop"}
        elif event.verb == "clear":
            self.latched -= {event.text}
            if event.text == "measurement_faults":
                self.faults = 0
            elif event.text == "wall_clock" and self.unix[0] - self.read > 2:  # the time goes back for who says so
                self.revoked |= {facts.id for facts in self.stored if facts.expires_unix_s <= self._wall()}
                self.unix = (self.read, event.t_ns)
        elif event.verb == "permit" and math.isfinite(event.duration_s) and 0.0 <= event.duration_s <= 86_400.0:
            self.permit = event.t_ns + round(event.duration_s * S) if event.duration_s else None
        elif event.verb == "revoke":
            self.revoked |= {facts.id for facts in self.stored if event.text in ("", facts.id)}

    # ------------------------------------------------------------------ what may drive

    def _wall(self) -> int:
        """The time of day: never earlier than before, and carried on by the host's clock."""
        return self.unix[0] + (0 if self.settings.lockstep else max(0, self.now - self.unix[1]) // S)

    def _against_controller(self) -> str:
        """Why no controller may drive now, or empty."""
        s, x = self.settings, self.good.x if self.good else ()
        wall = self._wall()
        covers = [
            c
            for c in self.stored
            if (c.controller_digest, c.model_digest, c.task_digest, c.profile_digest)
            == (self.running, self.model, s.task_digest, s.profile_digest)
            and self.gap is not None
            and c.epoch == self.gap.epoch
            and c.id not in self.revoked
            and wall < c.expires_unix_s
            and self.radius <= c.verified_radius
        ]
        wrong = {
            "down": self.up != {"link", "recorder", "analytics"},
            "latched": bool(self.latched),
            "nothing runs": self.running is None,
            "no certificate": not covers,
            "alarm": self.alarmed,
            "faults": self.faults > s.max_measurement_faults,
            "not seen": not self.usable or not 0 <= self.now - self.good_ns <= s.observation_timeout_ns,
            "outside": not self._inside(x, s.region),
        }
        return ", ".join(name for name, so in wrong.items() if so)

    def _inside(self, x: tuple[float, ...], bounds: tuple[tuple[float, float], ...]) -> bool:
        rows = zip(self.settings.states, x, bounds, strict=False)
        return len(x) == len(bounds) and all(name in self.settings.angles or low <= value <= high for name, value, (low, high) in rows)

    def _against_sampler(self) -> str:
        x = self.good.x if self.good else ()
        wrong = {
            "down": not {"link", "recorder"} <= self.up,
            "stopped": bool(self.latched & STOPS),
            "no permit": self.permit is None or self.now >= self.permit,
            "no campaign": not self.sampling,
            "not seen": not self.usable or not 0 <= self.now - self.good_ns <= self.settings.observation_timeout_ns,
            "outside": not self._inside(x, self.settings.geofence),
        }
        return ", ".join(name for name, so in wrong.items() if so)

    def _clear(self, event: m.Event) -> None:
        """Since when nothing stands against the controller. A refused command of its own counts as something."""
        if self._against_controller() or self.refused:
            self.clear = None
        elif self.clear is None:
            self.clear = event.t_ns

    # ------------------------------------------------------------------ what was sent

    def _instant(self, event: m.Event) -> bool:
        """Whether this event begins a control instant: an observation in order that no later one can be nearer to a point of the grid
        than, where the last interval between observations goes on. In lockstep, where one comes a step: at least 0.9 dt after the last
        instant. An unusable one can be an instant too, but what stamp it has is believed for one period only.
        """
        if not isinstance(event, m.Observed):
            return False
        seen, last, dt = event.observation, self.instant_stamp, self.settings.dt_ns
        if seen == self.good or (self.latest is not None and seen.seq == self.latest.seq):
            return False
        usable = not seen.fault and len(seen.x) == 3 and all(map(math.isfinite, seen.x))
        ordered = self.good is not None and seen.seq > self.good.seq and seen.stamp_ns > self.good.stamp_ns
        if self.good is not None and ordered and usable:
            self.report = min(seen.stamp_ns - self.good.stamp_ns, dt)
        before = self.report
        if self.asked is not None and not self.anew and not self.paused:
            return False
        wanted = self.origin + (self.index + 1) * dt
        due = last is None or Fraction(before, 2) >= wanted - seen.stamp_ns
        if last is not None and self.settings.lockstep and before > Fraction(dt, 2):
            due = seen.stamp_ns - last >= Fraction(9 * dt, 10)
        if not usable:
            if due:
                self._on_grid(seen.stamp_ns if last is None else min(seen.stamp_ns, last + dt))
            return False
        fresh = self.good is None or (seen.seq > self.good.seq and seen.stamp_ns > self.good.stamp_ns)
        return fresh and (due or (last is not None and seen.stamp_ns < last))

    def _on_grid(self, stamp: int) -> None:
        """An instant: it takes the nearest grid point, one that no instant had."""
        if self.instant_stamp is None or stamp < self.instant_stamp:
            self.origin, self.index = stamp, 0
        else:
            nearest = math.floor(Fraction(stamp - self.origin, self.settings.dt_ns) + Fraction(1, 2))
            self.index = max(self.index + 1, nearest)
        self.instant_stamp = stamp

    def _sends(self, event: m.Event, outputs: tuple[m.Output, ...], instant: bool) -> None:
        lockstep, sends = self.settings.lockstep, of(list(outputs), m.Send)
        if instant and isinstance(event, m.Observed):
            assert self.answered or lockstep or self.anew or self.paused, "an instant before this one got no command"
            self.instant, self.answered = event.observation.seq, False
            self._on_grid(event.observation.stamp_ns)
            self.last = None  # whatever number it has, nothing was sent for it yet
        for output in outputs:
            if isinstance(output, m.GateChanged):
                self.gate = output.open
            elif isinstance(output, m.Ask):
                assert self.asked is None
                self.asked, self.asked_ns = output, event.t_ns
            elif isinstance(output, m.Send):
                self._send(event, output)
        once = len({send.obs_seq for send in sends}) == len(sends)
        assert len(sends) <= 2, "more commands than instants"
        assert once or (self.anew and {send.source for send in sends} == {"recovery"}), "two commands for one observation"
        if instant and not lockstep:
            assert self.answered or self.asked is not None, "an instant without command or question"
        if isinstance(event, m.Proposed) and event.command.source == "external":
            assert not sends or (self.anew and {send.source for send in sends} == {"recovery"})
        if isinstance(event, m.Requested) and event.verb == "stop" and not lockstep:
            assert sends or event.t_ns < 0

    def _send(self, event: m.Event, send: m.Send) -> None:
        s = self.settings
        assert len(send.u) == 2
        assert all(math.isfinite(value) and low <= value <= high for value, (low, high) in zip(send.u, s.input_bounds, strict=True))
        assert 0 <= send.ttl_ns <= s.command_ttl_ns
        again = (
            s.lockstep
            and isinstance(event, m.Observed)
            and self.last is not None
            and self.last.obs_seq == send.obs_seq
            and self.asked is None
        )
        if send.source == "recovery":
            if self.latched & STOPS or isinstance(event, m.Stopping):
                assert send.u == (0.0, 0.0)
        elif again:
            assert self.last is not None
            assert (send.u, send.source) == (self.last.u, self.last.source)
        else:
            assert isinstance(event, m.Proposed), "a source's command without its proposal"
            self._allowed(event.command, send)
        if send.source == "controller":
            assert not self._against_controller(), self._against_controller()
            assert self.gate, "it opened before it was recorded"
            assert self.clear is not None
            assert self.now - self.clear >= s.hysteresis_ns
        elif send.source == "sampler":
            assert not self._against_sampler(), self._against_sampler()
        else:
            assert send.source == "recovery", send.source
        if self.last is not None and self.last.obs_seq == send.obs_seq:
            assert again or ((not s.lockstep or self.anew) and send.source == "recovery"), "a second command for one instant"
        self.asked, self.answered, self.last = None, True, send

    def _allowed(self, command: m.Command, send: m.Send) -> None:
        assert self.asked is not None, "nobody asked"
        assert (command.source, command.obs_seq, command.u) == (self.asked.source, self.asked.obs_seq, send.u)
        assert (send.source, send.obs_seq) == (command.source, command.obs_seq)
        assert not command.fault
        ttl = min(command.ttl_ns, self.settings.command_ttl_ns)
        assert 0 <= self.now - command.t_ns <= ttl
        assert 0 <= self.now - self.asked_ns <= ttl

    # ------------------------------------------------------------------ order and answers

    def _order(self, outputs: tuple[m.Output, ...]) -> None:
        """What is spent, and what certifies, is on disk before anything rests on it."""
        for output in outputs:
            match output:
                case m.Persist():
                    assert output.memory.epochs >= self.disk.epochs
                    assert output.memory.attempts >= self.disk.attempts
                    assert set(self.disk.revoked) <= set(output.memory.revoked)
                    self.disk = output.memory
                case m.StartCampaign():
                    assert self.disk.campaign_epoch == output.epoch
                    assert self.disk.epochs >= output.epoch
                    assert output.resume or output.epoch > self.epochs
                    self.epochs = max(self.epochs, output.epoch)
                case m.StartJob(kind="verify"):
                    assert self.disk.attempts == output.attempt > self.attempts
                    self.attempts = output.attempt
                case m.AttemptSpent():
                    assert self.disk.attempts == output.attempt
                case m.StartController():
                    assert output.certificate_id in {facts.id for facts in self.disk.certificates}
                case _:
                    pass
        assert self.latched <= set(self.disk.latched) or not self.started, "a latch that a restart would forget"

    def _answers(self, event: m.Event, outputs: tuple[m.Output, ...]) -> None:
        if isinstance(event, m.Requested):
            self.requests |= {event.request_id}
        for answer in of(list(outputs), m.Answer):
            if answer.final:
                assert answer.request_id in self.requests
                assert answer.request_id not in self.final, "answered twice"
                self.final |= {answer.request_id}
