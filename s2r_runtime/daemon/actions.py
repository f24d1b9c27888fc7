"""Carries out what the core decided, in its order, and makes durable what must be before anything rests on it.

    opened, certificate installed, memory, beta spent      on the disk before the next action
    closed                                                 the commands of that event go out first, then everything is logged

If the disk does not take what must be durable, the log or the state, what would have rested on it does not happen: each refused
action becomes the event that says so, and the gate hears that the recorder failed. While the state is unsaved nothing new begins at
all: an attempt whose beta a kill would give back is none.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import msgspec

from s2r_runtime import messages as m
from s2r_runtime.controllers.file import ControllerFile
from s2r_runtime.core import stream
from s2r_runtime.core.status import against_sampler
from s2r_runtime.daemon.analytics import Watching
from s2r_runtime.daemon.console import campaign_line
from s2r_runtime.daemon.saver import Saver
from s2r_runtime.daemon.settings import fault_jump_of
from s2r_runtime.daemon.worker import Failed, GapJob, Progress, Result, TraceJob, VerifyJob
from s2r_runtime.evidence import seeds

if TYPE_CHECKING:
    from s2r_runtime.daemon.loop import Daemon

KEPT_CONTROLLERS = 8
"""Loaded controllers that are remembered; a deployment that comes later loads its own again."""
KEPT_EPISODES = 1000
SAVE_AGAIN_NS = 1_000_000_000
GAP_TIMEOUT_S = 300.0


RESTS = m.DrawSeed | m.StartJob | m.StartCampaign | m.StartInputs | m.StartController | m.IssueCertificate
"""What rests on the saved state, whichever event saved it."""


def must_be_durable(output: m.Output) -> bool:
    """Whether nothing may rest on this before the disk has it (docs/gate.md)."""
    if isinstance(output, m.GateChanged):
        return output.open
    if isinstance(output, m.Persist):
        return not output.later
    return isinstance(output, m.CertificateInstalled | m.AttemptSpent | m.EpochChanged)


class Actions:
    """Everything that an output makes the daemon do. `unsaved`: why the memory isn't on the disk, or empty."""

    def __init__(self, daemon: Daemon) -> None:
        self._d = daemon
        self.unsaved = ""
        self.last_sent = 0
        self._refused_for = ""
        self.results: dict[str, Any] = {}
        self.last_trace: m.TraceEnded | None = None
        self.episodes: deque[m.EpisodeEnded] = deque(maxlen=KEPT_EPISODES)
        self._memory: m.Memory | None = None
        self._saver = Saver(daemon.folder)
        self._save_again_ns = 0
        self._controllers: dict[str, ControllerFile] = {}
        self._do: dict[type, Callable[[Any], None]] = {
            m.Ask: self._ask,
            m.Send: self._send,
            m.StartCampaign: self._start_campaign,
            m.StartInputs: self._start_inputs,
            m.StopCampaign: self._stop_campaign,
            m.StartController: self._start_controller,
            m.StopController: self._stop_controller,
            m.DrawSeed: self._draw_seed,
            m.StartJob: self._start_job,
            m.IssueCertificate: self._issue,
            m.Persist: self._persist,
            m.Answer: self._answer,
            m.ModelAdopted: self._model_adopted,
            m.TraceEnded: self._trace_ended,
        }

    def carry_out(self, outputs: Sequence[m.Output]) -> None:
        """One event's outputs."""
        put, sent = self._d.logbook.put, False
        if self._d.sampler.running and any(isinstance(output, m.Send) and output.source == "recovery" for output in outputs):
            self._refused_for = against_sampler(self._d.state, tuple(outputs))
        if any(isinstance(output, m.GateChanged) and not output.open for output in outputs):
            sent = True
            for output in outputs:
                if isinstance(output, m.Send):
                    self._send(output)
        waiting = False  # something logged must reach the disk before the next action
        for index, output in enumerate(outputs):
            do = self._do.get(type(output))
            if do is not None and (waiting or (self.unsaved and isinstance(output, RESTS))):
                waiting = False
                if self.unsaved or not self._d.logbook.durable():
                    self._refuse(outputs[index:], sent)
                    return
            if isinstance(output, m.Send) and not sent:
                self._send(output)
                put(output, output.t_ns)
                continue
            put(output, output.t_ns)
            if do is not None and not isinstance(output, m.Send):
                do(output)
            waiting = waiting or must_be_durable(output)
        if waiting and not self._d.logbook.durable():
            self._d.log_changed(False, self._d.logbook.health().detail or "the disk does not take the log")
        for output in outputs:
            if isinstance(output, m.GateChanged) or (isinstance(output, m.Decided) and not output.allow):
                self._d.link.inform(output)

    def tick(self, now_ns: int) -> None:
        """Tries again to save a memory that the disk did not take. now_ns: the host's clock."""
        if (trouble := self._saver.trouble) and not self.unsaved:
            self.unsaved = f"the state cannot be saved: {trouble}"
            self._d.log_changed(False, self.unsaved)
        if self.unsaved and self._memory is not None and now_ns >= self._save_again_ns:
            self._save_again_ns = now_ns + SAVE_AGAIN_NS
            self._save(self._memory)

    def close(self) -> None:
        """Saves what is not saved yet."""
        self._saver.close()

    def controller(self, digest: str) -> ControllerFile | None:
        """A controller that was loaded."""
        return self._controllers.get(digest)

    def keep_controller(self, file: ControllerFile) -> None:
        """A controller was loaded: its bytes are what runs and what the log holds, whatever becomes of the file."""
        self._controllers.pop(file.digest, None)
        self._controllers[file.digest] = file
        while len(self._controllers) > KEPT_CONTROLLERS:
            self._controllers.pop(next(iter(self._controllers)))
        self._d.logbook.attach(f"controller/{file.digest}", "application/json", msgspec.json.encode(file))

    # ------------------------------------------------------------------ the robot

    def _ask(self, ask: m.Ask) -> None:
        observation = self._d.observation
        if observation is None or observation.seq != ask.obs_seq:
            return  # it was overtaken; the newer one has its own question
        if ask.source == "sampler" and self._d.excitation.running:
            self._d.feed(*self._d.excitation.ask(ask.t_ns, observation, self._d.next_seq()))
        elif ask.source == "sampler":
            self._d.feed(*self._d.sampler.ask(ask.t_ns, observation))
        else:
            self._d.driver.ask(observation)

    def _send(self, send: m.Send) -> None:
        self.last_sent = send.seq
        for change in self._d.link.send(send):
            self._d.feed(change)
        self._d.watcher.sent(send)
        if send.source == "recovery" and self._d.sampler.running:
            self._d.sampler.refused(send.obs_seq, self._refused_for)

    # ------------------------------------------------------------------ sources

    def _start_campaign(self, order: m.StartCampaign) -> None:
        self._d.desk.note("sample", campaign_line(order, self._d.state))
        self._d.feed(*self._d.sampler.start(order, self._d.settings))

    def _start_inputs(self, order: m.StartInputs) -> None:
        self._d.feed(*self._d.excitation.start(order, self._d.settings))

    def _stop_campaign(self, order: m.StopCampaign) -> None:
        self._d.feed(*self._d.sampler.stop(order.t_ns, order.reason), *self._d.excitation.stop(order.t_ns, order.reason))

    def _start_controller(self, order: m.StartController) -> None:
        file = self._controllers.get(order.digest)
        if file is None:
            self._d.feed(m.SourceStopped(order.t_ns, "controller", "start_failed", "its file is not loaded; deploy it again"))
            return
        memory, profile = self._d.state.memory, self._d.profile
        if memory.gap is not None:
            stood, settings = msgspec.structs.asdict(stream.stood(memory)), self._d.settings
            jump = fault_jump_of(profile, settings.states, settings.angles, memory.gap)
            alpha, run_length = settings.alpha, settings.run_length
            watching = Watching(profile.model, memory.gap, jump, alpha=alpha, run_length=run_length, **stood)
            self._d.watcher.begin(watching)
        self.episodes.clear()
        self._d.driver.start(file, order.scenarios or m.Scenarios(self._d.settings.seed, 0, profile.task.episodes))

    def _stop_controller(self, _order: m.StopController) -> None:
        self._d.driver.stop()
        self._d.watcher.end()

    # ------------------------------------------------------------------ jobs

    def _draw_seed(self, order: m.DrawSeed) -> None:
        """What pays for the attempt is on the disk by now: until here nobody could know the seed."""
        simulated = self._d.simulated_seeds
        seed = seeds.drawn() if simulated is None else next(simulated)
        self._d.feed(m.SeedDrawn(order.t_ns, order.job_id, order.attempt, seed, fixed=simulated is not None))

    def _start_job(self, order: m.StartJob) -> None:
        job = self._job(order)
        self.results.pop(order.kind, None)
        if isinstance(job, str):
            self._d.feed(m.JobFinished(order.t_ns, order.job_id, order.kind, error=job))
            return
        profile = self._d.profile
        timeout_s = {"gap": GAP_TIMEOUT_S, "trace": profile.repair.timeout, "verify": profile.verification.timeout}[order.kind]
        self._d.workshop.start(job, timeout_s, lambda result: self._job_done(order, result), self._job_progress)

    def _job(self, order: m.StartJob) -> GapJob | VerifyJob | TraceJob | str:
        """The worker's job; or why there is none."""
        d, memory = self._d, self._d.state.memory
        if order.kind == "trace":
            return self._trace_job(order)
        samples = tuple(d.sampler.samples)
        if order.kind == "verify":
            file = self._controllers.get(order.digest)
            if file is None or memory.gap is None:
                return "its file is not loaded; deploy it again" if file is None else "there is no gap in force"
            radii = order.radius, order.hold_radius
            return VerifyJob(d.profile, file, memory.gap, *radii, order.attempt, order.seed, order.beta, order.least_radius)
        if d.sampler.epoch != order.epoch or not samples:
            return f"the samples of epoch {order.epoch} are not here any more"
        return GapJob(d.profile, samples, d.sampler.rejected, order.epoch, order.beta)

    def _trace_job(self, order: m.StartJob) -> TraceJob | str:
        """On the log that is being written, and for a campaign those before it: the worker waits until the order stands in it."""
        d = self._d
        if not order.stretch:
            return "it says not what to trace"
        logs = tuple(map(str, d.logbook.parts))
        if order.stretch == "campaign":
            if d.sampler.epoch != order.epoch:
                return f"the samples of epoch {order.epoch} are not here any more"
            logs = d.sampler.logs()
        return TraceJob(
            d.profile,
            order.stretch,
            order.epoch,
            order.rows,
            order.seed,
            logs=logs,
            run=d.logbook.run,
            job_id=order.job_id,
            out=str(d.models.folder),
            base=d.models.base,
        )

    def _job_done(self, order: m.StartJob, result: Result | Failed) -> None:
        if isinstance(result, Failed):
            self._d.feed(m.JobFinished(0, order.job_id, order.kind, error=result.text))
            return
        if result.trace is not None and result.trace["model_path"]:  # before the result, so that a reader of the log has the model by then
            self._d.logbook.attach(
                f"model/{result.trace['proposal']['digest']}", "application/toml", str(result.trace["model_toml"]).encode()
            )
        self.results[order.kind] = result.trace if order.kind == "trace" else result.gap or result.verification
        found = {name: getattr(result, name) for name in ("gap", "verification", "trace", "safety", "behaviour")}
        self._d.feed(m.JobFinished(0, order.job_id, order.kind, **found))

    def _job_progress(self, progress: Progress) -> None:
        self._d.desk.progress(progress.done, progress.total, progress.detail)

    # ------------------------------------------------------------------ what lasts

    def _persist(self, persist: m.Persist) -> None:
        if persist.later and not self.unsaved:
            self._memory = persist.memory
            self._saver.soon(persist.memory)
            return
        self._save(persist.memory)
        if self.unsaved:
            self._d.log_changed(False, self.unsaved)

    def _save(self, memory: m.Memory) -> None:
        self._memory = memory
        try:
            self._saver.now(memory)
            self.unsaved = ""
        except OSError as error:
            self.unsaved = f"the state cannot be saved: {error.strerror or error}"

    def _issue(self, order: m.IssueCertificate) -> None:
        from s2r_runtime.daemon.issuing import issue

        self._d.feed(issue(self._d, order))

    def _trace_ended(self, ended: m.TraceEnded) -> None:
        self.last_trace = ended

    def _model_adopted(self, adopted: m.ModelAdopted) -> None:
        self._d.use_model(adopted.digest)

    def _answer(self, answer: m.Answer) -> None:
        self._d.desk.answered(answer)

    # ------------------------------------------------------------------ what the disk refused

    def _refuse(self, outputs: Sequence[m.Output], sent: bool) -> None:
        """These would have rested on something that isn't on the disk. Stopping is always possible; nothing else happens."""
        if not self.unsaved:  # otherwise the gate heard it when the saving failed
            self._d.log_changed(False, self._d.logbook.health().detail or "the disk does not take the log")
        why = self.unsaved or "the log cannot be written"
        for output in outputs:
            self._d.logbook.put(output, output.t_ns)
            match output:
                case m.Send(source="recovery") if not sent:
                    self._send(output)
                case m.StopController() | m.StopCampaign() | m.Answer() | m.Persist() | m.ModelAdopted():
                    self._do[type(output)](output)
                case m.StartController():
                    self._d.feed(m.SourceStopped(0, "controller", "start_failed", why))
                case m.StartCampaign() | m.StartInputs():
                    self._d.feed(m.SourceStopped(0, "sampler", "start_failed", why))
                case m.DrawSeed():
                    self._d.feed(m.JobFinished(0, output.job_id, "verify", error=why))
                case m.StartJob():
                    self._d.feed(m.JobFinished(0, output.job_id, output.kind, error=why))
                case m.IssueCertificate():
                    self._d.feed(m.CertificateFailed(0, why, output.request_id))
                case _:
                    pass
