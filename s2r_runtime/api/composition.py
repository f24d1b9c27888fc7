"""Composed statements (guarantee G13): scenarios enclosed in tubes, runs from logs, and what both say of the real closed loop."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import msgspec

from s2r_runtime.api.jobs import gap_at, work
from s2r_runtime.api.models import weights_of
from s2r_runtime.api.progress import Watcher
from s2r_runtime.api.trials import check_logs, task_of
from s2r_runtime.controllers.linear_feedback import gain_of
from s2r_runtime.errors import ConfigError, ControllerError, NotEnoughEvidence, UsageError
from s2r_runtime.evidence import seeds
from s2r_runtime.evidence.bounds import attempt_beta, sample_size
from s2r_runtime.evidence.composition import RATE_SLACK, composed, enclosure_limit, inside_runs
from s2r_runtime.evidence.driven_runs import read_driven_runs
from s2r_runtime.evidence.enclosure import NOT_PROVED, tube_for
from s2r_runtime.evidence.simulated_runs import fitted_on_runs
from s2r_runtime.evidence.uncertain import GapSet
from s2r_runtime.messages import Composition, Enclosure, InsideRuns
from s2r_runtime.models.composed import ComposedModel
from s2r_runtime.profile import Profile

if TYPE_CHECKING:
    from s2r_runtime.controllers.file import ControllerFile

TIGHTER = 4
"""By which the enclosure's limit is below `verification.epsilon` if every scenario is enclosed: it is one of two terms."""


NO_RADIUS = "verification.run_radius is 0; it fixes, before the runs, up to which residual a run stays in the gap set (G13)"


class Tubes(NamedTuple):
    """How scenarios are enclosed. rate: of the closed loop, as a person states it, and why; 0: the controller is linear feedback."""

    rate: float = 0.0
    because: str = ""


def tubes_of(rate: float | None, because: str, *, enclose: bool) -> Tubes | None:
    """What was requested; None: no enclosure. Raises UsageError for a rate without a reason, or a reason without a rate."""
    if rate is not None and not 0.0 < rate < float("inf"):
        raise UsageError(f"--rate {rate:g}: must be above 0 and finite")
    if (rate is not None) != bool(because.strip()):
        raise UsageError("--rate L and --because TEXT go together: the rate is an assumption, and its reason is part of the statement")
    if rate is not None and not enclose:
        raise UsageError("--rate goes with --enclose: it is the rate of the tubes in which scenarios are enclosed")
    return Tubes(rate or 0.0, because.strip()) if enclose else None


def check_tubes(tubes: Tubes, controller: ControllerFile, model: ComposedModel, profile: Profile, radius: float) -> None:
    """Raises UsageError where no tube can be had. Nothing is run."""
    if radius <= 0.0:
        raise UsageError("the gap set has radius 0, in which there is no disturbance to enclose")
    norm = GapSet(profile.norm.set, weights_of(model.states, {}, profile), radius)
    tube_for(gain_of(controller), tubes.rate, task_of(profile, model), model, norm, profile.verification.threshold)


def enclosure_of(
    tubes: Tubes,
    controller: ControllerFile,
    model: ComposedModel,
    profile: Profile,
    radius: float,
    watcher: Watcher,
    *,
    beta: float,
    n: int = 0,
    seed: int | None = None,
) -> Enclosure:
    """n scenarios (0: what `verification.epsilon` / 4 needs), each compared with its tube. seed: None for one that founds nothing.

    Raises UsageError without a tube, NotEnoughEvidence if drawn states refute the stated rate, ControllerError if the controller fails.
    """
    from s2r_runtime.daemon.worker import EncloseJob, Result

    check_tubes(tubes, controller, model, profile, radius)
    n = n or sample_size(profile.verification.epsilon / TIGHTER, beta)
    digests = (controller.digest, model.spec.digest(), profile.task_digest())
    seed = seeds.known("enclose", *digests) if seed is None else seed
    gap = gap_at(radius, None, model, profile)
    changed = msgspec.structs.replace(profile, model=model.spec)
    job = EncloseJob(changed, controller, gap, gap.radius, gap.hold_radius, tubes.rate, n, seed)
    done = work(job, profile.verification.timeout, "enclosing", watcher)
    if not isinstance(done, Result) or done.enclosed is None:
        raise ControllerError(f"the scenarios cannot be enclosed: {getattr(done, 'text', 'the worker gave no counts')}")
    found = done.enclosed
    if tubes.rate and found.rate_seen > tubes.rate * RATE_SLACK:
        raise NotEnoughEvidence(
            f"the stated rate {tubes.rate:g} is refuted: a state drawn in the tube stepped {found.rate_seen:.4g} times as far from the "
            f"undisturbed run as it was; {NOT_PROVED}"
        )
    return Enclosure(
        method="rate" if tubes.rate else "linear",
        rate=tubes.rate,
        because=tubes.because,
        radius=radius,
        n=n,
        failed=found.failed,
        upper=enclosure_limit(found.failed, n, beta),
        beta=beta,
        seed=seed,
        reach=found.reach,
        rate_seen=found.rate_seen,
        controller_digest=digests[0],
        model_digest=digests[1],
        task_digest=digests[2],
    )


def runs_inside(
    logs: Sequence[Path], controller: ControllerFile, model: ComposedModel, profile: Profile, watcher: Watcher, *, beta: float
) -> InsideRuns:
    """Runs of all certified controllers in these logs, which are audited first, against the profile's `verification.run_radius`.

    Raises ConfigError for a log that does not hold or of another radius, or a model that was fitted on these runs; NotEnoughEvidence.
    """
    radius = profile.verification.run_radius
    if radius <= 0.0:
        raise ConfigError(NO_RADIUS)
    check_logs(logs, watcher)
    norm = GapSet(profile.norm.set, weights_of(model.states, {}, profile), radius)
    found = read_driven_runs(logs, profile, task_of(profile, model), model, norm)
    if fitted_on_runs(model.spec.fitted_on, found.states):
        raise ConfigError("the model was fitted on rows of these runs, so their residuals on it are too small (G6); drive other runs")
    seed = seeds.known("ranks", profile.robot.name)  # one for the robot's life: with each run one more draw is looked at
    return inside_runs(found.runs, radius, beta=beta, controller=controller.digest, seed=seed, logs=found.heads)


def composition_of(
    logs: Sequence[Path], tubes: Tubes, controller: ControllerFile, model: ComposedModel, profile: Profile, watcher: Watcher, *, beta: float
) -> Composition:
    """From logs, with confidence 1-beta in all. It founds no certificate. Raises as `runs_inside` and `enclosure_of`."""
    runs = runs_inside(logs, controller, model, profile, watcher, beta=beta / 2.0)
    return composed(enclosure_of(tubes, controller, model, profile, runs.radius, watcher, beta=beta / 2.0), runs)


class Composing(NamedTuple):
    """A composed statement for a certificate: what it needs. tubes None: it was not requested. logs: of runs; none: no first term."""

    tubes: Tubes | None
    logs: Sequence[Path]
    controller: ControllerFile
    model: ComposedModel
    profile: Profile
    watcher: Watcher

    def check(self) -> None:
        """Before an attempt is spent. Raises UsageError without a tube, ConfigError for logs that do not hold or without a radius."""
        if self.tubes is None:
            return
        if self.profile.verification.run_radius <= 0.0:
            raise ConfigError(f"{NO_RADIUS}; no attempt was spent")
        check_tubes(self.tubes, self.controller, self.model, self.profile, self.profile.verification.run_radius)
        if self.logs:
            self._runs(1)

    def made(self, attempt: int, seed: int) -> Composition | None:
        """At this attempt's shares. None, with a line that says why, where the scenarios cannot be enclosed or the runs do not count."""
        if self.tubes is None:
            return None
        radius, beta = self.profile.verification.run_radius, attempt_beta(self.profile.guarantee.beta_composition, attempt)
        try:
            enclosure = enclosure_of(self.tubes, self.controller, self.model, self.profile, radius, self.watcher, beta=beta, seed=seed)
            return composed(enclosure, self._runs(attempt) if self.logs else None)
        except (ControllerError, NotEnoughEvidence) as error:
            self.watcher.notes("composition", [f"no composed statement: {error}"])
            return None

    def _runs(self, attempt: int) -> InsideRuns:
        beta = attempt_beta(self.profile.guarantee.beta_composition, attempt)
        return runs_inside(self.logs, self.controller, self.model, self.profile, self.watcher, beta=beta)
