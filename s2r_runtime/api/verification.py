"""`s2r verify` and `s2r.verify`: a controller on the uncertain model, and what that shows (guarantees G2 and G8)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec

from s2r_runtime.api.composition import enclosure_of, tubes_of
from s2r_runtime.api.jobs import gap_at, work
from s2r_runtime.api.models import ModelLike, ProfileLike, controller_at, load_checked, profile_model, weights_of
from s2r_runtime.api.options import check_counts, check_named_numbers, check_numbers
from s2r_runtime.api.progress import Callback, Watcher, watcher_of
from s2r_runtime.api.recordings import RecordingLike, recording
from s2r_runtime.api.results import AFTER, LIMIT, Result, axes_of
from s2r_runtime.api.spelling import front_door
from s2r_runtime.errors import ConfigError, NotEnoughEvidence, RecordingError, UsageError
from s2r_runtime.evidence.statements import of_enclosure
from s2r_runtime.evidence.verify import seed_for, verification_json
from s2r_runtime.messages import Enclosure, Gap, Verification
from s2r_runtime.models.composed import ComposedModel
from s2r_runtime.profile import Profile

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from s2r_runtime.controllers.file import ControllerFile
    from s2r_runtime.recordings.tables import Source
    from s2r_runtime.recordings.transitions import Transitions

LAWS = ("uniform", "persistent", "adversarial")
"""Names of the disturbance models."""
LOAD_TIMEOUT_S = 30.0
"""For a learned policy to start and give its first answer; the daemon's too."""


class Verified(Result):
    """What `VerifyResult` and `Certification` share."""

    verification: Verification

    @property
    def passed(self) -> bool:
        """Whether it passed under every required disturbance model."""
        return self.verification.passed

    @property
    def radius(self) -> float:
        """Radius of the gap set at which it was verified, in the norm's unit."""
        return self.verification.radius

    @property
    def statement(self) -> str:
        """What is claimed, in sentences."""
        return str(self.to_dict()["statement"])

    def plot(self, ax: Axes | None = None) -> Axes:
        """Least safety value under each disturbance model, with the threshold as a line. Returns the axes."""
        (here,) = axes_of(1, ax)
        results = self.verification.laws
        threshold = self.verification.threshold
        here.barh([one.law for one in results], [one.s_star for one in results], color=[AFTER if one.passed else LIMIT for one in results])
        here.axvline(threshold, color=LIMIT, linestyle="--", label=f"threshold {threshold:g}")
        here.set_xlabel("least safety value s*")
        here.legend(frameon=False)
        return here


@dataclass(frozen=True, eq=False, repr=False)
class VerifyResult(Verified):
    """Rollouts of a controller on the uncertain model. A pass holds for that model, not for the robot: see `not_shown` of `to_dict()`."""

    verification: Verification
    gap_radius: float
    """Of the gap that it was verified for, in the norm's unit."""
    enclosure: Enclosure | None = None
    """Scenarios compared with tubes at that radius, if that was requested."""

    def to_dict(self) -> dict[str, Any]:
        """What `s2r verify --json` prints."""
        enclosed: dict[str, Any] = {}
        if self.enclosure is not None:
            enclosed["enclosure"] = {**msgspec.to_builtins(self.enclosure), "statement": of_enclosure(self.enclosure)}
        return {**verification_json(self.verification), "gap_radius": self.gap_radius, **enclosed}

    def summary(self) -> str:
        """What `s2r verify` prints."""
        lines = verification_lines(self.to_dict())
        return "\n".join(lines if self.enclosure is None else [*lines, of_enclosure(self.enclosure)])


@front_door
def verify(
    controller: str | Path,
    *,
    profile: ProfileLike,
    model: ModelLike | None = None,
    radius: float | None = None,
    recording: RecordingLike | None = None,
    hold_radius: float | None = None,
    headroom: float | None = None,
    n: int = 0,
    law: Sequence[str] | str = (),
    param: Mapping[str, float] | None = None,
    max_gb: float | None = None,
    enclose: bool = False,
    rate: float | None = None,
    because: str = "",
    progress: Callback | bool | None = None,
) -> VerifyResult:
    """Runs a controller on the uncertain model, in a confined process. It spends no budget and founds no certificate.

    controller: a Python file with `control(x, theta, parameters)`, or a learned policy (`.onnx`). profile: the robot's.
    model: a repaired model instead of the profile's.
    radius: of the gap set, in the norm's unit (0: the model as it is); or recording: a campaign that radius and hold gap come from.
    hold_radius: hold gap (with `radius`; default: the radius times sqrt(hold periods)). headroom: verify up to this multiple of the radius.
    n: scenarios for each disturbance model (0: what beta needs). law: one or several of `uniform`, `persistent` and `adversarial`
    (default: the profile's). param: parameters of the controller. enclose: also compare scenarios with a tube that no disturbance in the
    gap set leaves (docs/composition.md). rate, because: of the tube, and its reason (default: the controller is linear feedback).
    progress: a function that takes a `Step`; True: tqdm; False: none.

    A controller that does not pass gives `passed == False`. Raises ConfigError (profile, model or controller), NotEnoughEvidence (n or the
    campaign is too small), RecordingError, UsageError.
    """
    check_numbers(radius=radius, hold_radius=hold_radius, headroom=headroom, max_gb=max_gb, rate=rate)
    check_counts(n=n)
    check_named_numbers(param=param)
    given = None if recording is None else _sources(recording)
    return verified(
        controller, profile, watcher_of(progress), model=model, radius=radius, recordings=given, hold_radius=hold_radius, headroom=headroom,
        n=n, law=(law,) if isinstance(law, str) else tuple(law), param=param or {}, max_gb=max_gb,
        enclose=enclose, rate=rate, because=because,
    )  # fmt: skip


def verified(
    controller: str | Path,
    profile: ProfileLike,
    watcher: Watcher,
    *,
    model: ModelLike | None,
    radius: float | None,
    recordings: Sequence[Source] | None,
    hold_radius: float | None,
    headroom: float | None,
    n: int,
    law: tuple[str, ...],
    param: Mapping[str, float],
    max_gb: float | None,
    enclose: bool = False,
    rate: float | None = None,
    because: str = "",
) -> VerifyResult:
    """As `verify`, with its options checked. recordings: paths, or tables in memory."""
    if (radius is None) == (recordings is None):
        raise UsageError("verify: needs either --radius R or --recording REC")
    if unknown := [one for one in law if one not in LAWS]:
        raise UsageError(f"--law {unknown[0]}: must be one of: {', '.join(LAWS)}")
    for option, value in (("radius", radius), ("hold-radius", hold_radius), ("n", n)):
        if value is not None and not 0.0 <= value < float("inf"):
            raise UsageError(f"{'-n' if option == 'n' else f'--{option}'} {value:g}: must be >= 0 and finite")
    tubes = tubes_of(rate, because, enclose=enclose)
    loaded = load_checked(profile)
    composed = profile_model(model, loaded, _name_of(profile))
    measured = gap_of(load_recordings(recordings, composed, loaded, watcher, max_gb)[0], composed, loaded)[0] if recordings else None
    laws = law or loaded.verification.laws
    gap = measured or gap_at(radius or 0.0, hold_radius, composed, loaded)
    share = headroom or (loaded.verification.headroom if measured else 1.0)
    if share < 1.0:
        raise UsageError(f"--headroom {share:g}: must be >= 1")
    file = checked_controller(controller, param, msgspec.structs.replace(loaded, model=composed.spec), watcher)
    seed = seed_for(file.digest, composed.spec.digest(), loaded.task_digest(), 1)
    beta = loaded.guarantee.beta
    enclosed = enclosure_of(tubes, file, composed, loaded, gap.radius, watcher, beta=beta, n=n) if tubes is not None else None
    result, _ = run_verification(file, composed, loaded, watcher, gap=gap, headroom=share, laws=laws, n=n, attempt=1, seed=seed, beta=beta)
    return VerifyResult(result, gap.radius, enclosed)


def checked_controller(path: str | Path, param: Mapping[str, float], profile: Profile, watcher: Watcher) -> ControllerFile:
    """The controller in that file; a learned policy is evaluated once on the profile's task. Raises UsageError, ConfigError."""
    from s2r_runtime.controllers.policy import is_policy
    from s2r_runtime.daemon.worker import Failed, LoadJob

    file = controller_at(path, param)
    if is_policy(file.entry) and isinstance(done := work(LoadJob(str(path), profile=profile), LOAD_TIMEOUT_S, "loading", watcher), Failed):
        raise ConfigError(done.text)
    return file


def load_recordings(
    sources: Sequence[Source], model: ComposedModel, profile: Profile, watcher: Watcher, max_gb: float | None = None
) -> tuple[Transitions, str]:
    """The transitions of the recordings, and the digest of all.

    Of several drives the first blocks count. Which ones those are may not depend on the order in which a person lists them, so several are
    digested first. max_gb: of one recording. Raises as `load_transitions`.
    """
    from s2r_runtime.files.canonical import digest_of_all
    from s2r_runtime.files.table_text import limits_of
    from s2r_runtime.recordings.loading import digest_of_source, load_transitions, look_at

    limits, digests, ordered = limits_of(max_gb), [], list(sources)
    for one in sources:
        look_at(one, limits)
    if len(sources) > 1:
        try:
            digested = sorted(((digest_of_source(one), one) for one in sources), key=lambda pair: (pair[0], str(pair[1])))
        except OSError as error:
            raise RecordingError(f"{error.filename}: cannot be read: {error.strerror}") from None
        digests, ordered = [digest for digest, _ in digested], [one for _, one in digested]
    found = load_transitions(ordered, model, dict(profile.columns), transport=profile.transport, limits=limits)
    watcher.notes(found.source, found.notes)
    return found, digest_of_all(digests or [found.digest])


def gap_of(
    found: Transitions, model: ComposedModel, profile: Profile, *, beta: float | None = None, epoch: int = 1
) -> tuple[Gap, str, str]:
    """The gap of a campaign under the profile's settings, or of driving for which the profile states an assumption.

    Also returns that assumption, and which period of each hold gave the sample. beta: the epoch's share; without one the gap founds no
    certificate. Raises NotEnoughEvidence if it carries no statement.
    """
    from s2r_runtime.evidence import blocked
    from s2r_runtime.evidence.gap import doubted, estimate_gap
    from s2r_runtime.messages import NOT_INDEPENDENT, REPEATED

    share = beta or profile.guarantee.beta
    if found.drive is not None and profile.driving.block > 0.0:
        epsilon, discard = profile.guarantee.epsilon, profile.guarantee.discard
        angles = model.angle_columns
        found = blocked.founding(found, profile.driving, model.dt, epsilon=epsilon, share=share, discard=discard, angles=angles)
    if not found.independent:
        raise NotEnoughEvidence(
            f"{found.source}: is ordinary driving, not a campaign; its transitions are not independent, so its gap carries no statement, "
            "unless the profile vouches for blocks of it: [driving]"
        )
    gap = estimate_gap(
        model,
        found,
        epsilon=profile.guarantee.epsilon,
        beta=share,
        discard=profile.guarantee.discard,
        kind=profile.norm.set,
        weights=weights_of(model.states, {}, profile),
        epoch=epoch,
    )
    doubtful = doubted(gap, found, (REPEATED,) if beta is None else NOT_INDEPENDENT)
    if doubtful is not found:
        raise NotEnoughEvidence(f"{found.source}: {doubtful.doubt}; its gap carries no statement")
    return gap, found.assumption, "first" if found.holds is None else found.holds.law


def run_verification(
    controller: ControllerFile,
    model: ComposedModel,
    profile: Profile,
    watcher: Watcher,
    *,
    gap: Gap,
    headroom: float,
    laws: tuple[str, ...],
    n: int,
    attempt: int,
    seed: int,
    beta: float,
) -> tuple[Verification, str]:
    """Verification at the largest radius from the gap's to `headroom` times it at which the controller passes.

    In a worker process: the controller's code runs confined, silenced, and for a limited time. A controller that ends the worker or
    outlasts `verification.timeout` has not passed, with that as the reason. Also returns its behaviour (`probe`), or an empty text.
    """
    from s2r_runtime.core.headroom import grid
    from s2r_runtime.daemon.worker import Failed, VerifyJob
    from s2r_runtime.daemon.worker import Result as Done
    from s2r_runtime.evidence.bounds import sample_size

    # disturbance models that were requested are what the question is about, even where the profile does not require them
    required = tuple(law for law in profile.verification.required if law in laws) or laws
    most = headroom * gap.radius
    share = beta / len(grid(gap.radius, most))
    needed = sample_size(profile.verification.epsilon, share)
    if 0 < n < needed:
        raise NotEnoughEvidence(
            f"-n {n}: {needed} scenarios are needed for epsilon {profile.verification.epsilon:g} and beta {share:.4g}: {needed - n} more",
            needed - n,
        )
    settings = msgspec.structs.replace(profile.verification, laws=laws, required=required, n=n or profile.verification.n)
    changed = msgspec.structs.replace(profile, model=model.spec, verification=settings)
    job = VerifyJob(changed, controller, gap, most, headroom * gap.hold_radius, attempt, seed, beta, gap.radius)
    done = work(job, settings.timeout, "verifying", watcher)
    if isinstance(done, Done) and done.verification is not None:
        return done.verification, done.behaviour
    failed = Verification(
        passed=False,
        radius=gap.radius,
        hold_radius=gap.hold_radius,
        threshold=settings.threshold,
        epsilon=settings.epsilon,
        beta=beta,
        attempt=attempt,
        seed=seed,
        laws=(),
        controller_digest=controller.digest,
        model_digest=model.spec.digest(),
        task_digest=profile.task_digest(),
        reason=done.text if isinstance(done, Failed) else "the worker gave no verification",
    )
    return failed, ""


def verification_lines(answer: Mapping[str, Any]) -> list[str]:
    """The account of a verification, from its plain data."""
    why = f": {answer['reason']}" if answer.get("reason") else ""
    lines = ["passed" if answer["passed"] else f"not passed{why}"]
    if answer["passed"] and "gap_radius" in answer and answer["split"] > 1:
        lines.append(f"gap {answer['gap_radius']:.4g}, verified to {answer['radius']:.4g}")
    for law, r in answer["laws"].items():
        failures = f"failures {r['failures']} (at most {r['failure_upper']:.2%})"
        note = "" if r["required"] else "  (reported, not required)"
        lines.append(f"  {law:12s} {r['n']:6d} scenarios  s* {r['s_star']:+.4f}  {failures}  progress {r['progress']:.3f}{note}")
    lines.append(answer["statement"])
    return lines + [f"  not shown: {line}" for line in answer["not_shown"] if answer["passed"]]


def _sources(given: RecordingLike) -> tuple[Source, ...]:
    return recording(given).sources


def _name_of(profile: ProfileLike) -> str:
    return "the profile" if isinstance(profile, Profile) else str(profile)
