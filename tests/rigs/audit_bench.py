"""A whole run in one process, in the time it takes to compute it: robot, core, campaign, gap, certificate, drive, watch; and liars.

What the daemon does with processes and sockets is done here by plain calls, in the daemon's order, into a list of what its log
would hold. A bench that is told to `lie` changes one thing where it arises; all that follows is consistent with the lie.
"""

from __future__ import annotations

import math
import random
import re
import sys
from collections import deque
from pathlib import Path
from typing import Any, ClassVar

import msgspec
import numpy as np
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from s2r_runtime import messages as m
from s2r_runtime.audit.core import in_effect_order
from s2r_runtime.audit.log import AuditResult, audit
from s2r_runtime.controllers.episodes import Episodes, end_report, score_report
from s2r_runtime.controllers.file import load
from s2r_runtime.core import ledger
from s2r_runtime.core import reducer as core
from s2r_runtime.core.headroom import grid
from s2r_runtime.core.status import against_sampler
from s2r_runtime.core.stream import stood
from s2r_runtime.daemon import jobs, trace_job
from s2r_runtime.daemon.excitation import Excitation
from s2r_runtime.daemon.given_inputs import parse_inputs
from s2r_runtime.daemon.settings import facts_of, fault_jump_of, settings_of
from s2r_runtime.daemon.worker import GapJob, TraceJob
from s2r_runtime.evidence.bounds import clopper_pearson_upper
from s2r_runtime.evidence.comparison import Campaign
from s2r_runtime.evidence.watch import Stream
from s2r_runtime.hookspecs import Offer, hookimpl
from s2r_runtime.models.composed import compose
from s2r_runtime.modelspec import ModelSpec, dump_model, parse_model
from s2r_runtime.plugins import registry
from s2r_runtime.profile import parse_profile
from s2r_runtime.recording.reading import Entry, read
from s2r_runtime.recording.writer import Writer
from s2r_runtime.trust import certificate as certificates

KEY = Ed25519PrivateKey.from_private_bytes(bytes(range(32)))
OTHER = Ed25519PrivateKey.from_private_bytes(bytes(range(1, 33)))
PUBLIC = KEY.public_key().public_bytes_raw()
START_UNIX_S = 1_700_000_000

PROFILE = """
clock = "lockstep"
[robot]
name = "bench"
[model]
name = "unicycle"
dt = 0.05
[region]
x = [-0.6, 0.6]
y = [-0.6, 0.6]
[inputs]
v = [-0.4, 0.4]
w = [-3.0, 3.0]
[geofence]
x = [-0.9, 0.9]
y = [-0.9, 0.9]
[norm]
weights = { theta = 0.05 }
[sampling]
hold_periods = 3
stop_periods = 2
waypoint_radius = 0.25
waypoint_margin = 0.2
[guarantee]
epsilon = 0.3
[verification]
epsilon = 0.3
[gate]
hysteresis = 0.1
[task]
name = "bench"
[transport]
name = "bench"
"""
CONTROLLER = "def control(x, theta, parameters):\n    return 0.0 * x[:, :2] + [0.1, 0.8]\n"


TRACED: dict[str, dict[str, Any]] = {}
"""Honest results by their rows: one trace is enough for all liars."""


def _effect(trace: dict[str, Any], **changes: float) -> list[Any]:
    effects: list[Any] = msgspec.json.decode(msgspec.json.encode(trace["effects"]))
    effects[0]["parameters"]["gain"].update(changes)
    return effects


def _other_model(trace: dict[str, Any]) -> dict[str, Any]:
    """All that it says of the model is changed, and fits."""
    text = re.sub(r'("gain" = )\S+', r"\g<1>0.9", str(trace["model_toml"]))
    return {"model_toml": text, "proposal": {**trace["proposal"], "digest": parse_model(text, ".", "lie").digest()}}


TRACE_LIES: dict[str, Any] = {
    "trace verdict": lambda _: {"verdict": "none"},
    "parameter": lambda t: {"effects": _effect(t, value=0.71)},
    "interval": lambda t: {"effects": _effect(t, low=0.2)},
    "effects": lambda _: {"effects": []},
    "traced model": lambda _: {"model": "sha256:" + "0" * 64},
    "range": lambda t: {"recording": {**t["recording"], "parts": [{**t["recording"]["parts"][0], "last": 999}]}},
    "rows": lambda t: {"recording": {**t["recording"], "digest": "sha256:" + "0" * 64}},
    "epoch": lambda t: {"recording": {**t["recording"], "epoch": 2}},
    "seed": lambda _: {"seed": 7},
    "options": lambda t: {"options": {**t["options"], "rows": 100}},
    "proposed digest": lambda t: {"proposal": {**t["proposal"], "digest": "sha256:" + "1" * 64}},
    "other model": _other_model,
    "error": lambda t: {"error": {**t["error"], "noise_floor": {}}},
    "another tracer": lambda t: {"tracer": t["tracer"] + 1, "error": {**t["error"], "noise_floor": {}}},
    "another tracer, rows": lambda t: {"tracer": t["tracer"] + 1, "seed": 7},
    "no tracer": lambda _: {"tracer": None},
}
"""What a trace may say of itself that isn't so."""


def _halved(event: Any) -> Any:
    """A command with half the input."""
    if not isinstance(event, m.Proposed):
        return event
    return msgspec.structs.replace(event, command=msgspec.structs.replace(event.command, u=tuple(0.5 * v for v in event.command.u)))


class BenchTransport:
    """JSON, and an external command now and then."""

    OPTIONS: ClassVar[dict[str, str]] = {}

    def __init__(self, options: dict[str, Any], states: tuple[str, ...], inputs: tuple[str, ...]) -> None:
        self._heard = False
        self._sent = 0

    def decode(self, frame: m.Frame) -> list[Any]:
        plain = msgspec.json.decode(frame.data)
        if "u" in plain:
            return [m.Command(0, frame.arrival_ns, "external", tuple(plain["u"]), plain["seq"], 0)]
        found: list[Any] = [] if self._heard else [m.LinkChanged(frame.arrival_ns, up=True)]
        self._heard = True
        return [*found, m.Observation(plain["seq"], plain["stamp"], tuple(plain["x"]))]

    def encode(self, command: m.Command) -> m.Frame:
        self._sent += 1
        return m.Frame(0, "command", msgspec.json.encode([self._sent, command.seq, command.u]), inbound=False)


class BenchTask:
    """Runs of 25 steps; the safety value falls with the distance from the line y = 0."""

    horizon = 25

    def __init__(self, *_: object) -> None:
        pass

    def draw_at(self, _rng: np.random.Generator, _x: Any) -> dict[str, Any]:
        return {}

    def view(self, scenario: dict[str, Any]) -> dict[str, Any]:
        return scenario

    def advance(self, scenario: dict[str, Any], _rng: np.random.Generator) -> dict[str, Any]:
        return scenario

    def begin(self, _scenario: dict[str, Any]) -> Any:
        return np.array([math.inf])

    def observe(self, tally: Any, x: Any, _scenario: dict[str, Any]) -> Any:
        return np.minimum(tally, 1.0 - np.abs(x[:, 1]))

    def done(self, tally: Any) -> Any:
        return np.zeros(len(tally), dtype=bool)

    def safety(self, tally: Any) -> Any:
        return tally

    def progress(self, tally: Any) -> Any:
        return np.ones(len(tally))

    def clearance(self, _x: Any, _scenario: dict[str, Any]) -> None:
        return None


@hookimpl
def s2r_tasks() -> list[Offer]:
    return [Offer("bench", f"{__name__}:BenchTask")]


@hookimpl
def s2r_transports() -> list[Offer]:
    return [Offer("bench", f"{__name__}:BenchTransport")]


if "bench" not in registry().names("transports"):
    registry().add("bench", "tests", "0", sys.modules[__name__])


class Bench:
    """One run. `items`: messages, or (name, media type, bytes) to attach. lie_at: how many messages stood before the lie."""

    def __init__(self, folder: Path, lie: str = "", memory: m.Memory | None = None, seed: int = 1) -> None:
        (folder / "controller.py").write_text(CONTROLLER)
        self.controller = load(folder / "controller.py")
        self.profile = parse_profile(PROFILE, "profile.toml", folder)
        self.model = compose(self.profile.model)
        facts = facts_of(self.model)
        self.settings = settings_of(self.profile, self.profile.model, facts)
        self.lie, self.lie_at = lie, -1
        self.items: list[Any] = [
            ("profile.toml", "application/toml", PROFILE.encode()),
            ("model.toml", "application/toml", dump_model(self.profile.model).encode()),
        ]
        self.rng = random.Random(seed)
        self.transport, self.robot_end = (BenchTransport({}, (), ()) for _ in range(2))
        self.state = core.initial()
        self.x, self.u, self.gain = [0.0, 0.0, 0.0], (0.0, 0.0), 1.0
        self.seq = self.t_ns = self.numbers = self.requests = 0
        self.queue: deque[m.Event] = deque()
        self.draining = False
        self.campaign: Campaign | None = None
        self.order: m.StartCampaign | None = None
        self.samples: list[m.SampleTaken] = []
        self.folder = folder
        self.excitation = Excitation()
        self.failing = ""
        self.earlier: list[Path] = []
        self.stream: Stream | None = None
        self.epoch, self.reason, self.driving = 0, "", False
        self.models: dict[str, ModelSpec] = {}
        settings = self._told("settings", self.settings, lambda s: msgspec.structs.replace(s, input_bounds=((-9.0, 9.0), (-9.0, 9.0))))
        self.feed(m.Started(0, START_UNIX_S, settings, memory or m.Memory(robot="bench", schema=m.MEMORY_SCHEMA)))

    # ---- the story

    def sample(self) -> Bench:
        """A campaign, and its gap."""
        self.step()
        self.ask("permit", duration_s=3600.0)
        self.ask("sample")
        while self.state.memory.gap is None and self.seq < 20_000:
            self.step()
        return self

    def drive(self, periods: int = 100) -> Bench:
        """Deploys the controller and lets it drive."""
        self.items.append((f"controller/{self.controller.digest}", "application/json", msgspec.json.encode(self.controller)))
        self.ask("deploy", digest=self.controller.digest)
        self.steps(periods)
        return self

    def interrupt(self) -> None:
        """The campaign is stopped by a person, and goes on."""
        self.ask("stop")
        self.ask("clear", text="emergency_stop")
        self.ask("sample")

    def trace(self, stretch: str = "campaign") -> Bench:
        """Traces a stretch of what is in the log so far."""
        self.ask("trace", text=stretch)
        return self

    def adopt(self, spec: ModelSpec | None = None) -> Bench:
        """A person adopts the model that was proposed, or his own."""
        if spec is not None:
            self.items.append((f"model/{spec.digest()}", "application/toml", dump_model(spec).encode()))
            self.models[spec.digest()] = spec
            self.ask("adopt", digest=spec.digest())
        elif (proposal := self.state.memory.proposal) is not None:
            self.ask("adopt", digest=proposal.digest)
        return self

    def excite(self, rows: int = 60) -> Bench:
        """Drives given inputs."""
        lines = [f"{0.05 * k:.3f},{0.3 * math.sin(0.4 * k):.6f},{2.0 * math.cos(0.3 * k):.6f}" for k in range(rows)]
        text = "t,v,w\n" + "\n".join(lines) + "\n"
        given = parse_inputs(text.encode(), "inputs.csv", self.model.inputs, self.profile.inputs, self.model.dt, {})
        self.excitation.keep(given)
        self.items.append((f"inputs/{given.digest}", "text/csv", text.encode()))
        self.ask("excite", digest=given.digest, count=rows)
        self.steps(rows + 3)
        return self

    def stop(self) -> Bench:
        """An orderly end."""
        self.feed(m.Stopping(0, "SIGTERM"))
        return self

    def steps(self, n: int) -> None:
        for _ in range(n):
            self.step()

    def ask(self, verb: Any, **fields: Any) -> None:
        self.requests += 1
        self.feed(m.Requested(0, self.requests, verb, 0, **fields))

    # ---- one period

    def step(self) -> None:
        """The robot is observed, answered, and moves."""
        measured = tuple(v + self.rng.gauss(0.0, 1e-3) for v in self.x)
        plain = {"seq": self.seq, "stamp": self.seq * 50_000_000, "x": measured}
        self.receive(msgspec.json.encode(plain))
        if self.seq % 50 == 7:
            self.receive(msgspec.json.encode({"u": [9.0, 9.0], "seq": self.seq}))
        v, w = self.u[0] * self.gain, self.u[1]
        x, y, theta = self.x
        self.x = [x + 0.05 * v * math.cos(theta), y + 0.05 * v * math.sin(theta), math.remainder(theta + 0.05 * w, 2 * math.pi)]
        self.seq += 1

    def receive(self, data: bytes) -> None:
        frame = m.Frame(self.t_ns + 1, "in", data)
        self.items.append(frame)
        for message in self.transport.decode(frame):
            if isinstance(message, m.Observation):
                self.t_ns = message.stamp_ns
                message = self._told("observation", message, lambda o: msgspec.structs.replace(o, x=(0.0, 0.0, 0.0)), self.seq == 200)
                measured = self.stream.observed(message) if self.stream is not None else None
                self.observation = message
                self.feed(m.Observed(0, message))
                if measured is not None:
                    measured = self._told("discrepancy", measured, lambda d: msgspec.structs.replace(d, discrepancy=d.discrepancy / 2))
                    self.feed(msgspec.structs.replace(measured, epoch=self.epoch))
            elif isinstance(message, m.Command):
                self.feed(m.Proposed(0, message))
            else:
                self.feed(message)

    def feed(self, *events: m.Event) -> None:
        self.queue.extend(events)
        if self.draining:
            return
        self.draining = True
        while self.queue:
            event = msgspec.structs.replace(self.queue.popleft(), t_ns=self.t_ns)
            self.items.append(event)
            if isinstance(event, m.LinkChanged):
                for one in filter(None, (self.stream, self.campaign)):
                    one.restarted()
            self.state, outputs = core.handle(self.state, event)
            self.reason = against_sampler(self.state, outputs)
            outputs = self._decided(outputs)
            self.items += outputs
            for output in in_effect_order(tuple(outputs)):
                self.carry_out(output)
        self.draining = False

    def _decided(self, outputs: tuple[m.Output, ...]) -> list[m.Output]:
        kept = list(outputs)
        for i, output in enumerate(kept):
            if isinstance(output, m.Decided) and not output.allow and output.source == "external":
                self.lie_at = len(self._messages()) + i if self.lie == "verdict" and self.lie_at < 0 else self.lie_at
                kept[i] = msgspec.structs.replace(output, allow=True) if self.lie == "verdict" else output
            if isinstance(output, m.GateChanged) and output.open and self.lie == "silent opening" and self.lie_at < 0:
                self.lie_at = len(self._messages()) + i
                del kept[i]
                break
        return kept

    # ---- what outputs do

    def carry_out(self, output: m.Output) -> None:
        match output:
            case m.Send():
                u = self._told("send", output.u, lambda u: (0.4, 0.0), output.source == "controller", before=False)
                command = m.Command(output.seq, output.t_ns, output.source, output.u, output.obs_seq, output.ttl_ns)
                if u != output.u:
                    command = msgspec.structs.replace(command, u=u)
                self.u = u
                self.lie_at = len(self._messages()) if self.lie == "send" and u != output.u and self.lie_at < 0 else self.lie_at
                self.items.append(self.transport.encode(command))
                if self.stream is not None:
                    self.stream.sent(output)
                if output.source == "recovery" and self.campaign is not None:
                    self.campaign.refused(output.obs_seq, self.reason)
            case m.Ask(source="sampler") if self.excitation.running:
                self.numbers += 1
                self.feed(*self._excited(output))
            case m.Ask(source="sampler"):
                self.feed(*self._sampler(output))
            case m.Ask():
                self.numbers += 1
                u = self._told("another face", (0.1, 0.8), lambda _: (0.15, 0.0))
                self.feed(*self._reports())
                self.feed(m.Proposed(0, m.Command(self.numbers, self.t_ns, "controller", u, output.obs_seq, 100_000_000)))
            case m.StartCampaign():
                self.order = output
                self.campaign = Campaign.from_settings(
                    self.settings, self.profile.sampling, n=output.n, epoch=output.epoch, seed=output.seed
                )
                if output.resume:
                    self.campaign.restore(self.snapshot)
                elif self.lie != "old samples":
                    self.samples.clear()
                else:
                    self.samples = [msgspec.structs.replace(sample, epoch=output.epoch) for sample in self.samples]
                again = [msgspec.structs.replace(sample, again=True) for sample in self.samples]
                self.snapshot = self.campaign.snapshot()
                self.feed(m.SourceStarted(0, "sampler", self.campaign.digest), *again)
            case m.StartInputs():
                self.feed(*self.excitation.start(output, self.settings))
            case m.StopCampaign() if self.excitation.running:
                self.feed(*self.excitation.stop(0, output.reason))
            case m.ModelAdopted():
                self.profile = msgspec.structs.replace(self.profile, model=self.models[output.digest])
                self.model = compose(self.profile.model)
                facts = facts_of(self.model)
                self.settings = settings_of(self.profile, self.profile.model, facts)
            case m.StopCampaign() if self.campaign is not None:
                assert self.order is not None
                rejected, self.campaign = self.campaign.progress().rejected, None
                ended = m.CampaignFinished(0, self.order.epoch, len(self.samples), False, rejected, output.reason)
                self.feed(m.SourceStopped(0, "sampler", "stopped", output.reason), ended)
            case m.StartJob(kind="gap"):
                self.feed(self._gap(output))
            case m.StartJob(kind="trace"):
                self.feed(self._trace(output))
            case m.DrawSeed():
                drawn = m.SeedDrawn(0, output.job_id, output.attempt, 4000 + output.attempt)
                self.feed(*self._told("an unpaid seed", (drawn,), lambda e: (msgspec.structs.replace(e[0], attempt=9), *e)))
            case m.StartJob(kind="verify"):
                self.feed(self._verify(output))
            case m.IssueCertificate():
                self.feed(self._issue(output))
            case m.StartController():
                gap = self.state.memory.gap
                assert gap is not None
                self.epoch = gap.epoch
                memory = self.state.memory
                jump = fault_jump_of(self.profile, self.model.states, tuple(self.model.nominal.angles), gap)
                self.stream = Stream(self.model, gap, fault_jump=jump, **msgspec.structs.asdict(stood(memory)))
                self.episodes, self.scored = Episodes(BenchTask(), self.settings.seed), (-1, False)
                self.feed(m.SourceStarted(0, "controller", output.digest))
            case m.StopController():
                self.stream = None
            case _:
                pass

    def _reports(self) -> list[m.Event]:
        """What the controller's process reports of its scenarios with this observation."""
        _, now, over = self.episodes.look(np.array(self.observation.x))
        found: list[m.Event] = []
        if over is not None:
            ended = end_report(0, over)
            better = msgspec.structs.replace(ended, safety=2.0)
            found += self._told("an episode left out", [ended], lambda _: [])
            found = self._told("a better episode", found, lambda _: [better])
        else:
            found = self._told("an episode put in", found, lambda _: [m.EpisodeEnded(0, 7, 25, 1.0, 1.0)], now.index == 1)
        self.scored, report = score_report(0, now, self.scored, self.profile.verification.threshold)
        return [*found, *([] if report is None else [report])]

    def _sampler(self, ask: m.Ask) -> list[m.Event]:
        assert self.campaign is not None
        assert self.order is not None
        step = self.campaign.step(self.observation)
        events: list[m.Event] = []
        if step.sample is not None:
            sample = self._told("sample", step.sample, lambda s: msgspec.structs.replace(s, x1=s.x0), len(self.samples) == 3)
            self.samples.append(sample)
            self.snapshot = self.campaign.snapshot()
            events.append(sample)
        if step.done or step.failed:
            rejected = self.campaign.progress().rejected
            self.campaign = None
            ended = m.CampaignFinished(0, self.order.epoch, len(self.samples), len(self.samples) >= self.order.n, rejected, step.failed)
            return [*events, m.SourceStopped(0, "sampler", "finished", step.failed), ended]
        u = self._told("input law", step.u, lambda u: (u[0] / 2, u[1] / 2), step.phase == "hold" and len(self.samples) == 3)
        self.numbers += 1
        return [*events, m.Proposed(0, m.Command(self.numbers, ask.t_ns, "sampler", u, ask.obs_seq, 100_000_000))]

    def _excited(self, ask: m.Ask) -> list[m.Event]:
        events = self.excitation.ask(ask.t_ns, self.observation, self.numbers)
        return self._told("given input", events, lambda e: [_halved(one) for one in e], self.seq % 40 == 0)

    def _trace(self, order: m.StartJob) -> m.JobFinished:
        """As the daemon's worker does it: on the log so far, in which the order stands."""
        log = self.write(self.folder / f"trace-{order.job_id}.mcap")
        if self.failing:
            return m.JobFinished(0, order.job_id, "trace", error=self.failing)
        logs = tuple(map(str, (*self.earlier, log)))
        job = TraceJob(self.profile, order.stretch or "campaign", order.epoch, order.rows, order.seed, logs, "bench", order.job_id)
        found = trace_job.cut_out(job)
        assert found is not None
        cut, identities = found
        if cut.about.digest not in TRACED:
            TRACED[cut.about.digest] = trace_job.trace(msgspec.structs.replace(job, cut=cut, identities=identities), lambda *_: None)
        trace = TRACED[cut.about.digest]
        for lie, change in TRACE_LIES.items():
            trace = self._told(lie, trace, lambda honest, change=change: {**honest, **change(honest)})
        text = str(trace["model_toml"])
        spec = parse_model(text, ".", "bench")
        self.models[spec.digest()] = spec
        if spec.effects != self.profile.model.effects:
            attached = self._told(
                "forgetful model", text, lambda t: "".join(x for x in t.splitlines(True) if not x.startswith("fitted_on"))
            )
            if self.lie != "no model":
                self.items.append((f"model/{spec.digest()}", "application/toml", attached.encode()))
        return m.JobFinished(0, order.job_id, "trace", trace=trace)

    def _gap(self, order: m.StartJob) -> m.JobFinished:
        gap = jobs.gap(GapJob(self.profile, tuple(self.samples), {}, order.epoch, order.beta))
        gap = self._told("gap", gap, lambda g: msgspec.structs.replace(g, radius=0.9 * g.radius))
        return m.JobFinished(0, order.job_id, "gap", gap=gap)

    def _verify(self, order: m.StartJob) -> m.JobFinished:
        """Numbers as a verification has them; the rollouts are not this bench's business."""
        split = len(grid(order.least_radius, order.radius))
        n = ledger.sample_size(0.3, order.beta / split)
        values = [0.5 + i for i in range(n)]
        least = self._told("safety", 0.5, lambda s: 0.9)
        upper = clopper_pearson_upper(0, n, order.beta / split)
        laws = tuple(m.LawResult(law, n, least, 0, upper, 1.0, True, True, True) for law in ("uniform", "persistent"))
        s = self.settings
        digests = (self.controller.digest, s.model_digest, s.task_digest)
        found = m.Verification(True, order.radius, order.hold_radius, 0.0, 0.3, order.beta, order.attempt, order.seed, laws, *digests)
        tried = (m.RadiusTried(split - 1, order.radius, True, 0.5),) if split > 1 else ()
        found = msgspec.structs.replace(found, split=split, tried=self._told("headroom", tried, lambda _: ()))
        return m.JobFinished(0, order.job_id, "verify", verification=found, safety={law.law: values for law in laws})

    def _issue(self, order: m.IssueCertificate) -> m.CertificateStored:
        made = certificates.issue(
            profile=self.profile,
            controller=self.controller,
            gap=order.gap,
            verification=order.verification,
            issued_unix_s=START_UNIX_S,
            lifetime_s=order.lifetime_s,
            horizon=BenchTask.horizon,
            tries=order.tries,
        )
        made = self._told("certificate", made, lambda c: msgspec.structs.replace(c, not_shown=()))
        facts = certificates.facts(made)
        key = self._told("signer", KEY, lambda _: OTHER)
        self.items.append((f"certificate/{facts.id}", "application/json", certificates.sign(made, key)))
        return m.CertificateStored(0, facts, request_id=order.request_id)

    # ---- lies and logs

    def _told(self, name: str, value: Any, lie: Any, when: bool = True, *, before: bool = True) -> Any:
        """The value, or once, if this bench is to lie about that, another one."""
        if name != self.lie or not when or self.lie_at >= 0:
            return value
        if before:
            self.lie_at = len(self._messages()) + len(self.queue)
        return lie(value)

    def _messages(self) -> list[Any]:
        return [item for item in self.items if not isinstance(item, tuple)]

    def write(self, path: Path, run: str = "bench", key: Ed25519PrivateKey | None = KEY, **options: Any) -> Path:
        """The log of what happened."""
        writer = Writer(path, run=run, signer=key, metadata={"robot": "bench"}, timed=False, **options)
        for number, item in enumerate(self.items):
            if isinstance(item, tuple):
                writer.attach(*item)
            else:
                writer.write(item, getattr(item, "t_ns", 0))
            if number % 100 == 0:
                writer.flush()
        writer.close()
        return path


def audited(bench: Bench, path: Path) -> AuditResult:
    """What an audit says of its log, the key being known."""
    return audit([bench.write(path)], PUBLIC)


def entries(path: Path) -> list[Entry]:
    """All messages of a log."""
    return list(read(path))
