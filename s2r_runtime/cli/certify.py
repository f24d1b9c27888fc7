"""s2r certify: gap + verify + sign, offline. The budget is kept in a ledger beside the key (guarantee G4)."""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import TYPE_CHECKING

import msgspec

from s2r_runtime.cli import output
from s2r_runtime.cli.choices import add_limit, apart, controller_at, load_checked, own_file, writable
from s2r_runtime.errors import UsageError

if TYPE_CHECKING:
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

    from s2r_runtime.controllers.file import ControllerFile
    from s2r_runtime.messages import Gap, Trials, Tries, Verification
    from s2r_runtime.models.composed import ComposedModel
    from s2r_runtime.profile import Profile


def add(verbs: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Adds the verb."""
    verb = verbs.add_parser("certify")
    verb.add_argument("controller", type=Path, metavar="CONTROLLER", help="a Python file with control(x, theta, parameters)")
    verb.add_argument("--profile", type=Path, required=True, metavar="P", help="the robot's profile (TOML)")
    verb.add_argument(
        "--recording",
        type=Path,
        action="append",
        required=True,
        metavar="REC",
        help="a campaign's MCAP; or drives, also folders of bags, if the profile vouches for blocks of them ([driving]); may be repeated",
    )
    verb.add_argument("-o", "--output", type=Path, required=True, metavar="CERT", help="where the certificate goes")
    verb.add_argument(
        "--trials", type=Path, action="append", default=[], metavar="LOG", help="closed-loop runs of it, from this log; may be repeated"
    )
    verb.add_argument("--model", metavar="MODEL.toml", help="a repaired model instead of the profile's")
    verb.add_argument("--key", type=Path, metavar="FILE", help="signing key (default: the user's; make one with s2r keys new)")
    verb.add_argument("--param", action="append", default=[], metavar="K=V", help="a parameter of the controller; may be repeated")
    add_limit(verb)
    verb.add_argument("--json", action="store_true", help="print one JSON object")
    verb.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Exit 0 with a certificate written, 1 if the controller did not pass (the attempt is spent all the same)."""
    from s2r_runtime.cli.evidence import gap_of, load_recordings, profile_model, run_verification
    from s2r_runtime.cli.trials_verb import trials_of
    from s2r_runtime.evidence.bounds import attempt_beta, epoch_beta
    from s2r_runtime.trust import keys, offline_ledger

    writable(args.output, replaced=True)  # now, because what is spent below stays spent, whatever becomes of the certificate
    inputs = {"the controller": args.controller, "the profile": args.profile, "the model": args.model}
    inputs |= {f"the recording {path}": path for path in args.recording}
    apart({"-o": args.output}, {**inputs, "the key": args.key or keys.default_path()})
    profile = load_checked(args.profile)
    model = profile_model(args, profile)
    apart({"-o": args.output}, {"the model's file": own_file(model.spec)})
    key_path = args.key or keys.default_path()
    key = keys.load(key_path)
    controller = controller_at(args.controller, args.param)
    found, recording = load_recordings(args.recording, model, profile, args.max_gb)
    trials = trials_of(args.trials, controller, model, profile) if args.trials else None
    ledger, beta = offline_ledger.open_ledger(key_path, profile.robot.name), profile.guarantee.beta
    epoch = ledger.epoch_for(recording, model.spec.digest(), profile.digest())
    gap, assumption, period = gap_of(found, model, profile, beta=epoch_beta(beta, epoch), epoch=epoch)
    attempt = ledger.spend_attempt(controller.digest, epoch=epoch)
    result, behaviour = run_verification(
        controller,
        model,
        profile,
        gap=gap,
        headroom=profile.verification.headroom,
        laws=profile.verification.laws,
        n=0,
        attempt=attempt,
        seed=ledger.draw_seed(attempt),
        beta=attempt_beta(beta, attempt),
    )
    tries = ledger.ended(attempt, behaviour)
    trouble = ""
    if result.passed:
        try:
            _write(args.output, profile, model, controller, gap, result, trials, tries, assumption, period, key)
        except UsageError as error:  # the attempt is spent: what it showed is told all the same
            trouble = str(error)
    _tell(args, gap, trials, result, tries, epoch, ledger.spent(beta), beta, written=result.passed and not trouble)
    if trouble:
        output.err(f"s2r: {trouble}")
        return UsageError.exit_code
    return 0 if result.passed else 1


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
    )
    try:
        durable.replace(path, certificate.sign(issued, key))
    except OSError as error:
        raise UsageError(f"{path}: cannot be written: {error.strerror}") from None


def _tell(
    args: argparse.Namespace,
    gap: Gap,
    trials: Trials | None,
    result: Verification,
    tries: Tries,
    epoch: int,
    spent: float,
    beta: float,
    *,
    written: bool,
) -> None:
    """beta: of the whole budget."""
    from s2r_runtime.cli.evidence import print_verification
    from s2r_runtime.evidence.verify import verification_json

    answer = verification_json(result)
    if args.json:
        output.result_json(
            {
                **answer,
                "certificate": str(args.output) if written else None,
                "gap": gap,
                "trials": trials,
                "tries": tries,
                "verified_radius": result.radius if result.passed else None,
                "epoch": epoch,
                "attempt": result.attempt,
                "beta_spent": spent,
                "beta_left": beta - spent,
            }
        )
        return
    print_verification(answer)
    output.out(f"gap epoch {epoch}, verification attempt {result.attempt}: {spent:.4f} of beta {beta} spent")
    output.out(f"on this gap: {tries.on_gap} attempts on {tries.controllers} controllers that differ in their behaviour")
    told = f"gap {gap.radius:.4g}, certified to {result.radius:.4g}: certificate written to {args.output}"
    output.out(told if written else "no certificate")
