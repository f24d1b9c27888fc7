"""One run's log, entry by entry, through everything that recomputes it."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import msgspec

from s2r_runtime.audit.beside import Beside
from s2r_runtime.audit.campaign import CampaignReplay
from s2r_runtime.audit.certificates import Certificates
from s2r_runtime.audit.core import CoreReplay, in_effect_order
from s2r_runtime.audit.driven import DrivenAgain
from s2r_runtime.audit.evidence import Evidence, attached_controller
from s2r_runtime.audit.findings import Findings
from s2r_runtime.audit.inputs import InputsReplay
from s2r_runtime.audit.older import as_recorded
from s2r_runtime.audit.runs import RunsReplay
from s2r_runtime.audit.traces import RELEVANT, Traces
from s2r_runtime.core.state import unix_now
from s2r_runtime.core.status import against_sampler
from s2r_runtime.daemon.settings import ModelFacts, facts_of, settings_of
from s2r_runtime.errors import ConfigError
from s2r_runtime.files.bounded_file import read_bounded
from s2r_runtime.files.canonical import digest
from s2r_runtime.messages import (
    EPISODES,
    GRID,
    RULES,
    SEEDS,
    AnswerLate,
    Ask,
    AttemptSpent,
    CampaignFinished,
    CertificateStored,
    Decided,
    DrawSeed,
    EpisodeEnded,
    EpisodeScored,
    EpochChanged,
    Event,
    InputsFinished,
    IssueCertificate,
    JobFinished,
    LinkChanged,
    ModelAdopted,
    Observation,
    Observed,
    Output,
    Persist,
    Proposed,
    RecorderChanged,
    Revoked,
    SampleTaken,
    Scenarios,
    SeedDrawn,
    Send,
    Settings,
    SourceStarted,
    SourceStopped,
    StartCampaign,
    StartController,
    Started,
    StartInputs,
    StartJob,
    StopController,
    Stopping,
    Ticked,
)
from s2r_runtime.modelspec import ModelSpec, parse_model
from s2r_runtime.plugins import registry
from s2r_runtime.profile import Profile, parse_profile
from s2r_runtime.recording.channels import CHANNELS
from s2r_runtime.recording.layout import Attached
from s2r_runtime.recording.reading import Entry, Reading

if TYPE_CHECKING:
    from collections.abc import Mapping

    from s2r_runtime.models.composed import ComposedModel


_ENCODE = msgspec.json.Encoder().encode
_ROUTES = {name: (name.partition("/")[0], name in RELEVANT) for name in CHANNELS}
"""Channel -> family, and whether a trace looks at it."""


class Across(NamedTuple):
    """What goes on from run to run. trusted: keys of the person who audits. rerun: whether attached code may run."""

    findings: Findings
    campaigns: CampaignReplay
    evidence: Evidence
    certificates: Certificates
    traces: Traces
    beside: Beside
    trusted: tuple[bytes, ...]
    rerun: bool


class RunAudit:
    """One run, over all its parts. Raises ConfigError or PluginError where this machine lacks what the log needs."""

    def __init__(self, across: Across) -> None:
        self._findings, self._campaigns, self._evidence, self._certificates = (
            across.findings,
            across.campaigns,
            across.evidence,
            across.certificates,
        )
        self._traces = across.traces
        self._trusted, self._rerun = across.trusted, across.rerun
        self._inputs, self._driven = InputsReplay(across.findings), DrivenAgain(across.findings)
        self._runs = RunsReplay(across.findings)
        self._observation: Observation | None = None
        self._core = CoreReplay(across.findings)
        self._beside, self._begun = across.beside, False
        self._profile: Profile | None = None
        self._reading: Reading | None = None
        self._attachments: dict[str, Attached] = {}
        self._taken = 0
        self._models: dict[str, ComposedModel | None] = {}
        self._sent_seq = self._seen_seq = -1
        self._now_ns: int | None = None
        self._event: Event | None = None
        self._entry: Entry | None = None
        self._campaigns.begin_run()
        self._certificates.begin_run()

    def part(self, reading: Reading) -> None:
        """The next file."""
        self._attached()
        self._reading, self._taken = reading, 0

    def entry(self, entry: Entry) -> None:
        """The next message."""
        self._entry = entry
        family, relevant = _ROUTES[entry.channel]
        if family == "event":
            event: Event = entry.message  # type: ignore[assignment]
            if (type(event) is Started) == (self._now_ns is not None):
                self._findings.differ(entry.index, entry.channel, "a run begins with its Started, and has no other", event, None)
            self._now_ns = event.t_ns
            if not as_recorded(_ENCODE(event), entry.raw):
                self._findings.differ(entry.index, entry.channel, "this is not how a recorder writes it", entry.raw, event)
            if relevant:
                self._traces.take(entry, event)
        elif relevant:
            self._traces.take(entry, entry.message)
        if self._now_ns is not None and entry.log_time_ns != self._now_ns:
            self._findings.differ(entry.index, entry.channel, "it stands at another time than it is of", entry.log_time_ns, self._now_ns)
        elif self._now_ns is None and family == "frame":
            self._findings.differ(entry.index, entry.channel, "it stands before the run begins", entry.raw, None)
        if family == "out":
            self._core.output(entry)
        elif family == "event":
            self._take(entry, event)
        elif family == "frame" and self._begun:
            self._beside.frame(entry)

    def end(self, *, clean: bool) -> None:
        """Nothing follows. clean: the log was closed and lacks nothing, so neither may its last event, if that is an orderly end."""
        stopped = isinstance(self._event, Stopping)
        self._driven.stop()
        if self._begun:
            last_act = None if stopped else self._last_act()
            self._beside.finish(self._entry, last_act, self._core.state.now_ns, clean=clean, stopped=stopped)
        self._core.end(complete=clean and stopped)
        if clean and not stopped and self._event is not None:
            self._findings.lack("an orderly end: the daemon broke down, and closed its log")

    # ---- events

    def _take(self, entry: Entry, event: Event) -> None:
        self._event = event
        self._evidence.settled()
        if isinstance(event, Started):
            self._begin(entry, event)
        if self._begun:
            self._beside.event(entry, event)
        if type(event) is not Ticked:  # the most frequent one
            self._before(entry, event)
        outputs = self._core.event(entry, event)
        state = self._core.state
        if state.settings is not None and state.settings.fault_share and any(isinstance(one, Send) for one in outputs):
            self._campaigns.decided(against_sampler(state, outputs))
        for output in in_effect_order(outputs):
            self._output(entry, output)
        if isinstance(event, JobFinished) and self._profile is not None:
            samples, rejected = self._campaigns.samples, self._campaigns.rejected
            self._evidence.finished(entry, event, self._profile, samples, rejected, self._attached())
            if event.kind == "trace":
                self._traced(entry, event, self._profile)

    def _traced(self, entry: Entry, event: JobFinished, profile: Profile) -> None:
        settings = self._core.state.settings
        if settings is not None:
            runnable = event.error == "" and self._compose(profile.model) is not None
            self._traces.finished(entry, event, profile, settings.states, self._attached(), runnable=runnable)

    def _before(self, entry: Entry, event: Event) -> None:
        """What is recomputed of an event, before the core's outputs take effect."""
        match event:
            case Observed(observation=observation):
                self._seen_seq, self._observation = observation.seq, observation
                self._campaigns.observed(observation)
                self._driven.observed(observation)
                self._runs.observed(observation)
            case LinkChanged():
                self._campaigns.restarted()
            case Proposed() if event.command.source == "sampler":
                (self._inputs if self._inputs.driving else self._campaigns).proposed(entry, event)
            case Proposed() if event.command.source == "controller":
                self._driven.proposed(entry, event)
                self._runs.answered(entry, event.command.obs_seq)
            case EpisodeEnded() | EpisodeScored():
                self._runs.reported(entry, event)
            case AnswerLate():
                self._driven.lost_track()
                self._runs.late()
            case SourceStopped(source="controller"):
                self._driven.stop()
                self._runs.gone(entry, event)
            case SampleTaken():
                self._campaigns.sample(entry, event)
            case CampaignFinished():
                self._campaigns.finished(entry, event)
            case InputsFinished():
                self._inputs.finished(entry, event)
            case SourceStarted(source="sampler"):
                (self._inputs if self._inputs.driving else self._campaigns).started(entry, event)
            case SourceStopped(source="sampler"):
                (self._inputs if self._inputs.driving else self._campaigns).stopped(entry, event)
            case SeedDrawn():
                self._evidence.seed_drawn(entry, event, self._core.state.settings)
            case RecorderChanged(ok=False):
                self._campaigns.doubted()
                self._evidence.doubted()
            case CertificateStored():
                self._stored(entry, event)
            case _:
                pass

    def _begin(self, entry: Entry, event: Started) -> None:
        """The run's first event: the profile, model and transport that all that follows is computed with."""
        attached = self._attached()
        for name in ("profile.toml", "model.toml"):
            if name not in attached:
                raise ConfigError(f"{self._where()}: {name} is not attached, so nothing can be recomputed")
        profile = self._profile_of(attached, event.settings)
        if profile.digest() != event.settings.profile_digest == profile.by_text().digest():
            profile = profile.by_text()
            self._findings.count("runs by an earlier version's rule: their profile's digest covers the whole text of its files")
        self._profile = self._with_model(profile, event.settings.model_digest)
        settings = event.settings
        facts = ModelFacts(settings.states, settings.inputs, settings.angles, any_step=settings.any_step)
        model = self._compose(self._profile.model)
        if model is not None:
            facts = facts_of(model)
        rules = settings.rules if 0 <= settings.rules <= RULES else RULES  # an earlier version's rules are run again as they were
        stated = settings_of(self._profile, self._profile.model, facts, settings.seed, rules, simulated=settings.simulated)
        if stated != settings:
            self._findings.differ(
                entry.index, entry.channel, "the settings are not those of the attached profile and model", settings, stated
            )
        self._evidence.begin_run(entry, event.memory)
        if self._reading is not None:
            self._traces.begin_run(self._reading.run, self._reading.public_key, settings.trace_rows, event.memory)
        self._certificates.remembered(entry, event.memory)
        options = {name: value for name, value in profile.transport.items() if name != "name"}
        name = str(profile.transport.get("name"))
        registry().get("transports", name)(options, facts.states, facts.inputs)  # a transport that is not here is said here
        self._beside.run(name, options, facts.states, facts.inputs, counts_faults=bool(settings.fault_share))
        if not settings.fault_share:
            self._findings.count("runs by an earlier version's rule: it let any number of faulty observations pass")
        if settings.rules < SEEDS:
            self._findings.count("runs by an earlier version's rule: the seed of a verification followed from digests and attempt")
        self._begun = True

    def _profile_of(self, attached: Mapping[str, Attached], settings: Settings) -> Profile:
        """The attached profile. Raises ConfigError; not by the log's fault: a version that checked less may have written it."""
        text = self._text(attached["profile.toml"])
        files = {name.removeprefix("profile/"): self._text(one) for name, one in attached.items() if name.startswith("profile/")}
        try:
            older = {"gate"} if not settings.fault_share else set()
            older |= {"sampling"} if settings.rules < GRID else set()
            return parse_profile(text, f"{self._where()}: profile.toml", Path(), files, as_before=older)
        except ConfigError as error:
            raise ConfigError(f"{error}; this version takes no such profile, so nothing can be recomputed") from None

    def _text(self, attached: Attached) -> str:
        try:
            return attached.data.decode()
        except UnicodeDecodeError as error:
            raise ConfigError(f"{self._where()}: {attached.name} is no text: {error}") from None

    def _stored(self, entry: Entry, event: CertificateStored) -> None:
        settings = self._core.state.settings
        if self._profile is None or settings is None or self._reading is None:
            return
        trusted = (self._reading.public_key, *self._trusted)
        now = unix_now(self._core.state)
        self._certificates.stored(entry, event, self._profile, settings, self._horizon, self._attached(), trusted, now)

    # ---- outputs, as they take effect

    def _output(self, entry: Entry, output: Output) -> None:
        state, profile = self._core.state, self._profile
        settings = state.settings
        if profile is None or settings is None:
            return
        match output:
            case Send():
                self._sent_seq = output.seq
                self._campaigns.sent(output)
                self._beside.sent(output)
            case Decided() if not settings.fault_share:
                self._campaigns.decided(output.reason)  # an earlier version took the gate's last word, whatever it was about
            case Ask(source="controller"):
                self._runs.shown(output.obs_seq)
            case Ask(source="sampler") if self._inputs.driving:
                self._inputs.ask(output, self._observation, settings.command_ttl_ns)
            case Ask(source="sampler"):
                self._campaigns.ask(output, settings.command_ttl_ns)
            case StartInputs():
                self._inputs.start(entry, output, profile, settings.inputs, self._attached())
            case StartCampaign():
                model = self._compose(profile.model)
                any_step = settings.any_step if model is None else model.any_step
                facts = ModelFacts(settings.states, settings.inputs, settings.angles, any_step=any_step)
                in_force = settings_of(profile, profile.model, facts, settings.seed, settings.rules, simulated=settings.simulated)
                self._campaigns.start(output, in_force, profile.sampling)
            case StartController():
                model = self._compose(profile.model)
                scenarios = output.scenarios or Scenarios(settings.seed, 0, profile.task.episodes)
                if settings.rules >= EPISODES:
                    self._runs.start(model, profile, scenarios)
                if self._rerun and model is not None:
                    self._driven.start(attached_controller(self._attached(), output.digest), model, profile.task, scenarios)
                if state.memory.gap is not None and model is not None:
                    self._beside.begin(profile, state.memory.gap, state.memory, lockstep=settings.lockstep, rules=settings.rules)
            case StopController():
                self._beside.stop()
                self._driven.stop()
                self._runs.stop(entry)
            case DrawSeed():
                self._evidence.paid(output)
            case StartJob():
                self._evidence.ordered(output, state.memory.gap)
            case IssueCertificate():
                self._certificates.issuing(output, traced=state.memory.traced)
            case EpochChanged() | AttemptSpent():
                self._evidence.spent(entry, output, settings.beta)
            case Persist() if not output.later:  # the disk may not have had it when the daemon was cut
                self._evidence.persisted(output.memory)
            case Revoked():
                self._certificates.revoked(output)
            case ModelAdopted(digest=adopted):
                self._traces.adopted(output)
                self._profile = self._with_model(profile, adopted)
            case _:
                pass

    # ---- what the log's attachments say

    def _where(self) -> str:
        return str(self._reading.path) if self._reading is not None else "log"

    def _attached(self) -> dict[str, Attached]:
        """By name; those of earlier parts count."""
        if self._reading is not None:
            for one in self._reading.attachments[self._taken :]:
                before = self._attachments.setdefault(one.name, one)
                if before.data != one.data:
                    index = -1 if self._entry is None else self._entry.index
                    self._findings.differ(index, "attachment", f"there are two attachments {one.name!r}, and they differ", None, None)
            self._taken = len(self._reading.attachments)
        return self._attachments

    def _with_model(self, profile: Profile, wanted: str) -> Profile:
        """The profile with the model of that digest, which must be attached."""
        for name, one in self._attached().items():
            if name == "model.toml" or name.startswith("model/"):
                spec = parse_model(one.data.decode(), ".", f"{self._where()}: {name}")
                if spec.digest() == wanted:
                    return msgspec.structs.replace(profile, model=spec)
        raise ConfigError(f"{self._where()}: the model {wanted} is not attached")

    def _compose(self, spec: ModelSpec) -> ComposedModel | None:
        key = spec.digest()
        if key not in self._models:
            self._models[key] = self._composed(spec)
        return self._models[key]

    def _composed(self, spec: ModelSpec) -> ComposedModel | None:
        """The model, ready to compute; None for a Python file, which runs only if that was asked for and it is the same file."""
        from s2r_runtime.models.composed import compose

        if spec.name.endswith(".py"):
            path = Path(spec.name)
            same = self._rerun and path.is_file() and digest(read_bounded(path)) == spec.source_digest
            if not same:
                self._findings.cannot(f"the model is the file {spec.name}, which runs only with --rerun-controllers and unchanged")
                return None
        return compose(spec, f"{self._where()}: model")

    def _horizon(self) -> int:
        """Of the profile's task."""
        profile = self._profile
        model = self._compose(profile.model) if profile is not None else None
        if profile is None or model is None:
            return 0
        return int(registry().get("tasks", profile.task.name)(profile.task.parameters, model.nominal, model.dt).horizon)

    def _last_act(self) -> Send | None:
        """What the daemon sends when it breaks down (exit code 70)."""
        state = self._core.state
        settings = state.settings
        if settings is None:
            return None
        held = settings.recovery_input if settings.recovery == "hold" else (0.0,) * len(settings.inputs)
        return Send(state.now_ns, self._sent_seq + 1, "recovery", held, self._seen_seq, settings.command_ttl_ns)
