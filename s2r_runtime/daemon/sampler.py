"""Runs a campaign inside the daemon: asks it for inputs, keeps its samples, and makes it survive an interruption.

The campaign is pure (`comparison`). What is kept on disk with every sample is its snapshot, its samples and the logs they are in;
a thread writes it, because a slow disk must not hold up the robot.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from typing import Any

import msgspec

from s2r_runtime.daemon.persistence import StateFolder
from s2r_runtime.errors import ConfigError
from s2r_runtime.evidence.comparison import Campaign
from s2r_runtime.messages import (
    CampaignFinished,
    Command,
    Event,
    Observation,
    Proposed,
    SampleTaken,
    Settings,
    SourceStarted,
    SourceStopped,
    StartCampaign,
)
from s2r_runtime.profile import Sampling

AGAIN_S = 1.0
"""Between two tries to keep a campaign that the disk did not take."""
AHEAD = 1
"""Samples that may be kept and not logged: the newest one may be kept before the log is given it; all before it are in the log first."""


class Kept(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A campaign as it is kept: what `Campaign.restore` takes, all samples so far, and the logs that hold their frames."""

    epoch: int
    n: int
    campaign: dict[str, Any]
    samples: tuple[SampleTaken, ...]
    logs: tuple[str, ...]


class Keeper:
    """Writes the newest of what it is given, from a thread of its own. A write that fails is told once, and tried again.

    logged: waits until the log has what it was given, and says whether it has. It goes first: a kept sample that no log has is one that
    somebody may have made up, and the campaign would not be gone on with.
    """

    def __init__(self, folder: StateFolder, logged: Callable[[], bool], complain: Callable[[str], None]) -> None:
        self._folder, self._logged, self._complain = folder, logged, complain
        self._newest: Kept | None = None
        self._wake = threading.Condition()
        self._ending = False
        self._thread = threading.Thread(target=self._run, name="campaign-keeper", daemon=True)
        self._thread.start()

    def keep(self, kept: Kept) -> None:
        """Returns at once; what was not written yet is replaced."""
        with self._wake:
            self._newest = kept
            self._wake.notify()

    def close(self) -> None:
        """Writes what is left and ends; may be called twice."""
        with self._wake:
            self._ending = True
            self._wake.notify()
        self._thread.join()

    def _run(self) -> None:
        failed = ""
        while True:
            with self._wake:
                while self._newest is None and not self._ending:
                    self._wake.wait()
                kept, self._newest = self._newest, None
            if kept is None:
                return
            try:
                if not self._logged():
                    raise OSError("the log does not take its samples")
                self._folder.save_campaign(kept)
                failed = ""
            except OSError as error:
                if str(error) != failed:
                    failed = str(error)
                    self._complain(f"the campaign cannot be kept, so an interruption would lose it: {error}")
                with self._wake:
                    if self._ending:
                        continue
                    self._newest = self._newest or kept
                    self._wake.wait_for(lambda: self._ending, AGAIN_S)


class Sampler:
    """The source `sampler`. Every method returns the events that came of it, in order."""

    def __init__(
        self,
        folder: StateFolder,
        keeper: Keeper,
        sampling: Sampling,
        logs: Callable[[], tuple[str, ...]],
        next_seq: Callable[[], int],
        before: Sequence[SampleTaken] = (),
    ) -> None:
        """logs: those of this run so far. next_seq: numbers the commands of all sources. before: samples in earlier logs, in order."""
        self._folder, self._keeper, self._sampling, self._logs, self._next_seq = folder, keeper, sampling, logs, next_seq
        self._before = before
        self._ttl_ns = 0
        self._campaign: Campaign | None = None
        self._earlier_logs: tuple[str, ...] = ()
        self.epoch = self.n = 0
        self.samples: list[SampleTaken] = []
        self.rejected: dict[str, int] = {}

    @property
    def running(self) -> bool:
        """Whether a campaign is under way."""
        return self._campaign is not None

    def logs(self) -> tuple[str, ...]:
        """The logs that hold the campaign's frames, oldest first."""
        return tuple(dict.fromkeys((*self._earlier_logs, *self._logs())))

    def start(self, order: StartCampaign, settings: Settings) -> list[Event]:
        """Begins or resumes a campaign. settings: those in force, with the model in force."""
        self._ttl_ns = settings.command_ttl_ns
        try:
            campaign = Campaign.from_settings(settings, self._sampling, n=order.n, epoch=order.epoch, seed=order.seed)
            kept = self._kept(order)
            if order.resume and (missing := self._missing(kept, order)):
                kept = kept or Kept(order.epoch, order.n, campaign.snapshot(), (), ())
                taken = (*kept.samples, *missing)
                kept = Kept(kept.epoch, kept.n, {**kept.campaign, "index": len(taken)}, taken, kept.logs)
            if kept is not None:
                campaign.restore(kept.campaign)
        except ConfigError as error:
            return [SourceStopped(order.t_ns, "sampler", "start_failed", str(error))]
        self.samples = list(kept.samples) if kept is not None else []
        self._earlier_logs = kept.logs if kept is not None else ()
        self._campaign, self.epoch, self.n = campaign, order.epoch, order.n
        self._keep()
        # a log that holds all samples of its campaign can be read alone, so those from before are logged again
        again = [msgspec.structs.replace(sample, t_ns=order.t_ns, again=True) for sample in self.samples]
        return [SourceStarted(order.t_ns, "sampler", campaign.digest), *again]

    def ask(self, t_ns: int, observation: Observation) -> list[Event]:
        """The campaign's answer to an observation."""
        campaign = self._campaign
        if campaign is None:
            return []
        try:
            step = campaign.step(observation)
        except Exception as error:  # noqa: BLE001 - a defect in the sampler closes the gate, it does not end the daemon
            return self._end(t_ns, "raised", f"{type(error).__name__}: {error}")
        events: list[Event] = []
        if step.sample is not None:
            sample = msgspec.structs.replace(step.sample, t_ns=t_ns)
            self.samples.append(sample)
            events.append(sample)
            self._keep()
        if step.done or step.failed:
            return events + self._end(t_ns, "finished", step.failed)
        command = Command(self._next_seq(), t_ns, "sampler", step.u, observation.seq, self._ttl_ns)
        return [*events, Proposed(t_ns, command)]

    def restarted(self) -> None:
        """The robot started anew, or the link to it was lost or found."""
        if self._campaign is not None:
            self._campaign.restarted()

    def refused(self, obs_seq: int, reason: str) -> None:
        """The gate let another input through: the sample under way does not count."""
        if self._campaign is not None:
            self._campaign.refused(obs_seq, reason)

    def stop(self, t_ns: int, detail: str) -> list[Event]:
        """Ends the campaign before it is complete; it can be resumed."""
        return self._end(t_ns, "stopped", detail) if self.running else []

    def progress(self) -> tuple[str, int, int, dict[str, int], float | None] | None:
        """(phase, taken, n, rejected, seconds left in the robot's time) of the campaign under way."""
        if self._campaign is None:
            return None
        p = self._campaign.progress()
        return p.phase, p.taken, p.n, p.rejected, p.left_s

    def recall(self, epoch: int) -> None:
        """The samples of that epoch's finished campaign, if they were kept: they can still be traced. A kept file that is no good is
        none: the gap that was found on it stands without it.
        """
        try:
            plain = self._folder.campaign()
            kept = None if plain is None else msgspec.convert(plain, Kept)
        except (ConfigError, msgspec.ValidationError):
            return
        if kept is not None and kept.epoch == epoch and len(kept.samples) == kept.n:
            self.epoch, self.n, self.samples, self._earlier_logs = kept.epoch, kept.n, list(kept.samples), kept.logs

    def _end(self, t_ns: int, reason: Any, detail: str) -> list[Event]:
        campaign, self._campaign = self._campaign, None
        assert campaign is not None  # noqa: S101 - callers checked
        complete = len(self.samples) >= self.n
        self.rejected = campaign.progress().rejected
        return [
            SourceStopped(t_ns, "sampler", reason, detail),
            CampaignFinished(t_ns, self.epoch, len(self.samples), complete, self.rejected, detail),
        ]

    def _keep(self) -> None:
        assert self._campaign is not None  # noqa: S101 - called while it runs
        self._keeper.keep(Kept(self.epoch, self.n, self._campaign.snapshot(), tuple(self.samples), self.logs()))

    def _missing(self, kept: Kept | None, order: StartCampaign) -> list[SampleTaken]:
        """Samples that stand in a log and were not kept: what was seen is not drawn once more, or somebody could choose (guarantee G1)."""
        samples = () if kept is None else kept.samples
        here = ([one for one in known if one.epoch == order.epoch] for known in (self._before, self.samples))
        told = max(here, key=len)[: order.n]
        if told and len(samples) > len(told) + AHEAD:
            raise ConfigError(
                f"{self._folder.path / 'campaign.json'}: has {len(samples)} samples of epoch {order.epoch}, its logs have {len(told)}; "
                "cancel the campaign (s2r sample PROFILE --cancel), its share of beta is spent"
            )
        for one, other in zip(samples, told, strict=False):
            if msgspec.structs.replace(other, t_ns=one.t_ns, again=one.again) != one:
                raise ConfigError(
                    f"{self._folder.path / 'campaign.json'}: sample {one.index} of epoch {order.epoch} is not the one that was logged; "
                    "cancel the campaign (s2r sample PROFILE --cancel), its share of beta is spent"
                )
        return told[len(samples) :]

    def _kept(self, order: StartCampaign) -> Kept | None:
        """What was kept of this epoch's campaign. Raises ConfigError if there should be something and it is not usable."""
        if not order.resume:
            return None
        plain = self._folder.campaign()
        if plain is None:
            return None
        try:
            kept = msgspec.convert(plain, Kept)
        except msgspec.ValidationError as error:
            raise ConfigError(f"{self._folder.path / 'campaign.json'}: was written by another version: {error}") from None
        if (kept.epoch, kept.n) != (order.epoch, order.n):
            wanted = f"epoch {order.epoch} with {order.n} samples"
            raise ConfigError(f"{self._folder.path / 'campaign.json'}: is of epoch {kept.epoch} with {kept.n} samples, not of {wanted}")
        if kept.campaign.get("index") != len(kept.samples):
            raise ConfigError(
                f"{self._folder.path / 'campaign.json'}: has {len(kept.samples)} samples and goes on at {kept.campaign.get('index')}; "
                "cancel the campaign (s2r sample PROFILE --cancel), its share of beta is spent"
            )
        return kept
