"""s2r certify: gap + verify + sign, offline. The budget is kept in a ledger beside the key (guarantee G4)."""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import msgspec

from s2r_runtime.cli import output
from s2r_runtime.cli.choices import controller_at, load_checked
from s2r_runtime.errors import UsageError


def add(verbs: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Adds the verb."""
    verb = verbs.add_parser("certify", help="gap + verify + sign: a certificate for this controller from a recorded campaign")
    verb.add_argument("controller", type=Path, metavar="CONTROLLER")
    verb.add_argument("--profile", type=Path, required=True, metavar="P")
    verb.add_argument(
        "--recording",
        type=Path,
        required=True,
        metavar="REC",
        help="a campaign's MCAP; or a drive, if the profile vouches for blocks of it ([driving])",
    )
    verb.add_argument("-o", "--output", type=Path, required=True, metavar="CERT")
    verb.add_argument(
        "--trials", type=Path, action="append", default=[], metavar="LOG", help="closed-loop runs of it, from this log; may be repeated"
    )
    verb.add_argument("--model", metavar="MODEL.toml", help="a repaired model instead of the profile's")
    verb.add_argument("--key", type=Path, metavar="FILE", help="signing key (default: the user's; make one with s2r keys new)")
    verb.add_argument("--param", action="append", default=[], metavar="K=V", help="a parameter of the controller; may be repeated")
    verb.add_argument("--json", action="store_true", help="print one JSON object")
    verb.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Exit 0 with a certificate written, 1 if the controller did not pass (the attempt is spent all the same)."""
    from s2r_runtime import certificate, keys, offline_ledger
    from s2r_runtime import verify as verification
    from s2r_runtime.bounds import attempt_beta, epoch_beta
    from s2r_runtime.canonical import digest
    from s2r_runtime.cli.evidence import gap_of, print_verification, profile_model, run_verification
    from s2r_runtime.cli.trials_verb import trials_of
    from s2r_runtime.daemon import persistence
    from s2r_runtime.plugins import registry

    profile = load_checked(args.profile)
    model = profile_model(args, profile)
    key_path = args.key or keys.default_path()
    key = keys.load(key_path)
    controller = controller_at(args.controller, args.param)
    try:
        recording = digest(args.recording.read_bytes())
    except OSError as error:
        raise UsageError(f"{args.recording}: cannot be read: {error.strerror}") from None
    trials = trials_of(args.trials, controller, model, profile) if args.trials else None
    ledger = offline_ledger.open_ledger(key_path, profile.robot.name)
    epoch = ledger.epoch_for(recording, model.spec.digest(), profile.digest())
    gap, assumption = gap_of(args.recording, model, profile, beta=epoch_beta(profile.guarantee.beta, epoch), epoch=epoch)
    attempt = ledger.spend_attempt(controller.digest)
    beta = attempt_beta(profile.guarantee.beta, attempt)
    headroom, laws = profile.verification.headroom, profile.verification.laws
    result = run_verification(controller, model, profile, gap=gap, headroom=headroom, laws=laws, n=0, attempt=attempt, beta=beta)
    spent = ledger.spent(profile.guarantee.beta)
    if result.passed:
        task = registry().get("tasks", profile.task.name)(profile.task.parameters, model.nominal, model.dt)
        issued = certificate.issue(
            profile=msgspec.structs.replace(profile, model=model.spec),
            controller=controller,
            gap=gap,
            verification=result,
            issued_unix_s=int(time.time()),
            horizon=task.horizon,
            trials=trials,
            assumption=assumption,
        )
        persistence.replace(args.output, certificate.sign(issued, key))
    if args.json:
        answer = verification.verification_json(result)
        output.result_json(
            {
                **answer,
                "certificate": str(args.output) if result.passed else None,
                "gap": gap,
                "trials": trials,
                "verified_radius": result.radius if result.passed else None,
                "epoch": epoch,
                "attempt": attempt,
                "beta_spent": spent,
                "beta_left": profile.guarantee.beta - spent,
            }
        )
    else:
        print_verification(verification.verification_json(result))
        output.out(f"gap epoch {epoch}, verification attempt {attempt}: {spent:.4f} of beta {profile.guarantee.beta} spent")
        told = f"gap {gap.radius:.4g}, certified to {result.radius:.4g}: certificate written to {args.output}"
        output.out(told if result.passed else "no certificate")
    return 0 if result.passed else 1
