"""`s2r certify` and `s2r.certify`: gap + verification + signature. The budget is in a ledger next to the key (guarantee G4)."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec

from s2r_runtime.api.composition import Composing, tubes_of
from s2r_runtime.api.files import apart, own_file, writable
from s2r_runtime.api.models import ModelLike, ProfileLike, load_checked, profile_model
from s2r_runtime.api.options import check_named_numbers, check_numbers
from s2r_runtime.api.progress import Callback, Watcher, watcher_of
from s2r_runtime.api.recordings import RecordingLike, recording
from s2r_runtime.api.spelling import front_door
from s2r_runtime.api.trials import Rollouts, trials_of
from s2r_runtime.api.verification import Verified, checked_controller, gap_of, load_recordings, run_verification, verification_lines
from s2r_runtime.errors import NotEnoughEvidence, UsageError
from s2r_runtime.evidence.bounds import attempt_beta, epoch_beta
from s2r_runtime.evidence.scores import SAFE
from s2r_runtime.evidence.statements import of_composition
from s2r_runtime.evidence.verify import verification_json
from s2r_runtime.messages import Composition, Gap, Trials, Tries, Verification
from s2r_runtime.profile import Profile
from s2r_runtime.trust import keys, offline_ledger
from s2r_runtime.trust.certificate import optimism_lack

if TYPE_CHECKING:
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

    from s2r_runtime.controllers.file import ControllerFile
    from s2r_runtime.models.composed import ComposedModel
    from s2r_runtime.recordings.tables import Source


ROLLOUTS = 20
"""Of each run in its scenario, and the same number in fresh ones, where the profile demands a limit of the model's optimism. The variance
of their means is then a twentieth of one rollout's.
"""


@dataclass(frozen=True, eq=False, repr=False)
class Certification(Verified):
    """One paid attempt at a certificate. It is spent whether or not the controller passed."""

    verification: Verification
    gap: Gap
    trials: Trials | None
    tries: Tries
    epoch: int
    beta: float
    """The whole error budget of this robot."""
    beta_spent: float
    output: Path
    written: bool
    """Whether the certificate is in `output`."""
    composition: Composition | None = None
    """What holds for the real closed loop, if that was requested and could be had."""
    trouble: str = ""
    """Why it is not, although the controller passed."""

    def to_dict(self) -> dict[str, Any]:
        """What `s2r certify --json` prints."""
        result = self.verification
        plain: dict[str, Any] = msgspec.to_builtins(
            {
                **verification_json(result),
                "certificate": str(self.output) if self.written else None,
                "gap": self.gap,
                "trials": self.trials,
                "tries": self.tries,
                "composition": self.composition,
                "verified_radius": result.radius if result.passed else None,
                "epoch": self.epoch,
                "attempt": result.attempt,
                "beta_spent": self.beta_spent,
                "beta_left": self.beta - self.beta_spent,
            }
        )
        return plain

    def summary(self) -> str:
        """What `s2r certify` prints."""
        result, lines = self.verification, verification_lines(verification_json(self.verification))
        lines.append(f"gap epoch {self.epoch}, verification attempt {result.attempt}: {self.beta_spent:.4f} of beta {self.beta} spent")
        lines.append(f"on this gap: {self.tries.on_gap} attempts on {self.tries.controllers} controllers that differ in their behaviour")
        lines += () if self.composition is None else of_composition(self.composition)
        written = f"gap {self.gap.radius:.4g}, certified to {result.radius:.4g}: certificate written to {self.output}"
        return "\n".join([*lines, written if self.written else "no certificate"])


@front_door
def certify(
    controller: str | Path,
    *,
    profile: ProfileLike,
    recording: RecordingLike,
    output: str | Path,
    trials: Sequence[str | Path] | str | Path = (),
    simulate: int = 0,
    model: ModelLike | None = None,
    key: str | Path | None = None,
    param: Mapping[str, float] | None = None,
    max_gb: float | None = None,
    enclose: bool = False,
    rate: float | None = None,
    because: str = "",
    runs: Sequence[str | Path] | str | Path = (),
    progress: Callback | bool | None = None,
) -> Certification:
    """Gap, verification and signature: a certificate for this controller. Every call spends an attempt of the key's budget.

    controller, profile, model, param, max_gb, progress: as `s2r.verify`. recording: a campaign, or drives for which the profile states an
    assumption. output: where the certificate goes. trials: logs of closed-loop runs of this controller. simulate: roll each of them
    out this number of times, and in fresh scenarios (default: 20 where the profile demands `max_optimism`, else 0). key: the signing key
    (default: the user's; `s2r keys new` makes one). enclose, rate, because: as `s2r.verify`, at the radius `verification.run_radius`;
    runs: logs of runs of any certified controllers, whose residuals are compared with it (docs/composition.md).

    A controller that does not pass gives `passed == False`, and no file. Raises UsageError where `output` cannot be written (with the
    attempt spent, if that shows only at the end), ConfigError (profile, key, ledger, a log that does not hold), NotEnoughEvidence.
    """
    check_numbers(max_gb=max_gb, rate=rate)
    check_named_numbers(param=param)
    driven = [runs] if isinstance(runs, str | Path) else list(runs)
    logs = [trials] if isinstance(trials, str | Path) else list(trials)
    found = certified(
        Path(controller), profile, _sources(recording), Path(output), watcher_of(progress), trials=[Path(log) for log in logs],
        simulate=simulate, model=model, key=None if key is None else Path(key), param=param or {}, max_gb=max_gb,
        enclose=enclose, rate=rate, because=because, runs=[Path(log) for log in driven],
    )  # fmt: skip
    if found.trouble:
        raise UsageError(f"{found.trouble}; attempt {found.verification.attempt} passed and is spent")
    return found


def certified(
    controller: Path,
    profile: ProfileLike,
    recordings: Sequence[Source],
    output: Path,
    watcher: Watcher,
    *,
    trials: Sequence[Path],
    simulate: int = 0,
    model: ModelLike | None,
    key: Path | None,
    param: Mapping[str, float],
    max_gb: float | None,
    enclose: bool = False,
    rate: float | None = None,
    because: str = "",
    runs: Sequence[Path] = (),
) -> Certification:
    """As `certify`; what hinders the writing of a certificate is in `trouble`, since its attempt is spent."""
    tubes = tubes_of(rate, because, enclose=enclose)
    if runs and tubes is None:
        raise UsageError("--runs goes with --enclose: their residuals are one term of a composed statement, enclosed scenarios the other")
    writable(output, replaced=True)  # now, because what is spent below stays spent, whatever becomes of the certificate
    key_path = key or keys.default_path()
    inputs: dict[str, Path | str | None] = {"the controller": controller}
    inputs["the profile"] = profile if isinstance(profile, str | Path) else None
    inputs["the model"] = model if isinstance(model, str | Path) else None
    inputs |= {f"the recording {one}": one for one in recordings if isinstance(one, Path)}
    apart({"-o": output}, {**inputs, "the key": key_path})
    loaded = load_checked(profile)
    composed = profile_model(model, loaded, str(profile) if isinstance(profile, str | Path) else "the profile")
    apart({"-o": output}, {"the model's file": own_file(composed.spec)})
    signing = keys.load(key_path)
    file = checked_controller(controller, param, msgspec.structs.replace(loaded, model=composed.spec), watcher)
    found, digest = load_recordings(recordings, composed, loaded, watcher, max_gb)
    ledger, beta = offline_ledger.open_ledger(key_path, loaded.robot.name), loaded.guarantee.beta
    epoch = ledger.epoch_for(digest, composed.spec.digest(), loaded.digest())
    gap, assumption, period = gap_of(found, composed, loaded, beta=epoch_beta(beta, epoch), epoch=epoch)
    tried = _trials(trials, simulate, file, composed, loaded, gap, watcher)
    if lack := optimism_lack(loaded, tried):
        raise NotEnoughEvidence(f"no certificate: {lack}; no attempt was spent")
    composing = Composing(tubes, runs, file, composed, loaded, watcher)
    composing.check()
    attempt = ledger.spend_attempt(file.digest, epoch=epoch)
    seed = ledger.draw_seed(attempt)
    result, behaviour = run_verification(
        file,
        composed,
        loaded,
        watcher,
        gap=gap,
        headroom=loaded.verification.headroom,
        laws=loaded.verification.laws,
        n=0,
        attempt=attempt,
        seed=seed,
        beta=attempt_beta(beta, attempt),
    )
    tries = ledger.ended(attempt, behaviour)
    trouble, composition = "", None
    if result.passed:
        composition = composing.made(attempt, seed)
        try:
            _write(output, loaded, composed, file, gap, result, tried, tries, assumption, period, signing, composition)
        except UsageError as error:  # the attempt is spent: what it showed is reported all the same
            trouble = str(error)
    written = result.passed and not trouble
    return Certification(
        verification=result,
        gap=gap,
        trials=tried,
        tries=tries,
        epoch=epoch,
        beta=beta,
        beta_spent=ledger.spent(beta),
        output=output,
        written=written,
        composition=composition,
        trouble=trouble,
    )


def _trials(
    logs: Sequence[Path], simulate: int, controller: ControllerFile, model: ComposedModel, profile: Profile, gap: Gap, watcher: Watcher
) -> Trials | None:
    """The controller's runs, with rollouts at the gap's radius under `uniform`, the disturbance model that flatters it most."""
    if not logs:
        return None
    number = simulate or (ROLLOUTS if profile.verification.max_optimism < 1.0 else 0)
    rollouts = Rollouts(number, gap.radius, "uniform", SAFE, model) if number else None
    return trials_of(logs, controller, model, profile, watcher, rollouts=rollouts)


def _write(
    path: Path,
    profile: Profile,
    model: ComposedModel,
    controller: ControllerFile,
    gap: Gap,
    result: Verification,
    trials: Trials | None,
    tries: Tries,
    assumption: str,
    period: str,
    key: Ed25519PrivateKey,
    composition: Composition | None,
) -> None:
    """The certificate, signed."""
    from s2r_runtime.files import durable
    from s2r_runtime.plugins import registry
    from s2r_runtime.trust import certificate

    task = registry().get("tasks", profile.task.name)(profile.task.parameters, model.nominal, model.dt)
    issued = certificate.issue(
        profile=msgspec.structs.replace(profile, model=model.spec),
        controller=controller,
        gap=gap,
        verification=result,
        issued_unix_s=int(time.time()),
        horizon=task.horizon,
        trials=trials,
        tries=tries,
        assumption=assumption,
        period=period,
        composition=composition,
    )
    try:
        durable.replace(path, certificate.sign(issued, key))
    except OSError as error:
        raise UsageError(f"{path}: cannot be written: {error.strerror}") from None


def _sources(given: RecordingLike) -> tuple[Source, ...]:
    return recording(given).sources
