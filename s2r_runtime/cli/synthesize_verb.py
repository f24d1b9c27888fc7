"""s2r synthesize: search a controller's parameters on the uncertain model, then verify the winner on fresh scenarios, paid for."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec

from s2r_runtime.api.files import apart, own_file, writable
from s2r_runtime.cli import output
from s2r_runtime.cli.choices import add_limit, count, positive
from s2r_runtime.cli.evidence import print_verification
from s2r_runtime.errors import ControllerError, UsageError
from s2r_runtime.recordings.units import number_of

if TYPE_CHECKING:
    from s2r_runtime.controllers.candidates import Candidate, Synthesis

SHOWN = 10
"""Candidates that are printed, the best first; --json has them all."""
SEARCH_TIMEOUT = 24 * 3600.0


def add(verbs: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Adds the verb."""
    verb = verbs.add_parser("synthesize")
    verb.add_argument("controller", type=Path, metavar="CONTROLLER", help="a controller with BOUNDS for its PARAMETERS")
    verb.add_argument("--profile", type=Path, required=True, metavar="P", help="the robot's profile (TOML)")
    verb.add_argument("-o", "--output", type=Path, required=True, metavar="FILE.py", help="where the winner goes, with its parameters")
    size = verb.add_mutually_exclusive_group(required=True)
    size.add_argument("--radius", type=positive, metavar="R", help="radius of the gap set")
    size.add_argument("--recording", type=Path, metavar="REC", help="take radius and hold gap from this campaign")
    verb.add_argument("--hold-radius", type=positive, metavar="R", help="hold gap (with --radius; default: R times sqrt(hold periods))")
    verb.add_argument("--model", metavar="MODEL.toml", help="a repaired model instead of the profile's")
    verb.add_argument("--bound", action="append", default=[], metavar="NAME=LOW:HIGH", help="instead of the file's; may be repeated")
    verb.add_argument("--evaluations", type=count, default=200, metavar="E", help="candidates to try (default 200)")
    verb.add_argument("--scenarios", type=count, default=100, metavar="N", help="scenarios for each candidate and law (default 100)")
    verb.add_argument("--seed", type=count, default=1, metavar="S", help="of the search (default 1)")
    verb.add_argument("--key", type=Path, metavar="FILE", help="key whose ledger pays for the verification (default: the user's)")
    add_limit(verb)
    verb.add_argument("--json", action="store_true", help="print one JSON object")
    verb.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Exit 0 if the winner passed verification, 1 if it did not (the attempt is spent all the same)."""
    from s2r_runtime.api.jobs import gap_at, work
    from s2r_runtime.api.models import controller_at, load_checked, profile_model
    from s2r_runtime.api.verification import gap_of, load_recordings, run_verification, verification_lines
    from s2r_runtime.controllers import candidates
    from s2r_runtime.daemon.worker import Failed, SynthesisJob
    from s2r_runtime.evidence.bounds import attempt_beta
    from s2r_runtime.evidence.verify import verification_json
    from s2r_runtime.files import durable
    from s2r_runtime.trust import keys, offline_ledger

    if args.evaluations < 2 or args.scenarios < 1:
        raise UsageError("--evaluations must be at least 2, --scenarios at least 1")
    writable(args.output, replaced=True)
    inputs = {"the controller": args.controller, "the profile": args.profile, "the recording": args.recording, "the model": args.model}
    apart({"-o": args.output}, {**inputs, "the key": args.key or keys.default_path()})
    profile = load_checked(args.profile)
    model, watcher = profile_model(args.model, profile, str(args.profile)), output.Terminal()
    apart({"-o": args.output}, {"the model's file": own_file(model.spec)})
    controller = controller_at(args.controller, {})
    if controller.modules and args.output.resolve().parent != args.controller.resolve().parent:
        raise UsageError(f"-o {args.output}: must lie beside {args.controller}, which imports {', '.join(controller.modules)} from there")
    bounds = candidates.declared_bounds(controller, dict(_bound(item) for item in args.bound))
    ledger = offline_ledger.open_ledger(args.key or keys.default_path(), profile.robot.name)
    if args.recording:
        gap = gap_of(load_recordings([args.recording], model, profile, watcher, args.max_gb)[0], model, profile)[0]
    else:
        gap = gap_at(args.radius, args.hold_radius, model, profile)
    headroom = profile.verification.headroom if args.recording else 1.0
    asked = msgspec.structs.replace(profile, model=model.spec)
    amid = headroom**0.5  # with room to spare, and not so much that nothing passes
    job = SynthesisJob(
        asked, controller, bounds, gap, amid * gap.radius, amid * gap.hold_radius, args.evaluations, args.scenarios, args.seed
    )
    done = work(job, SEARCH_TIMEOUT, "searching", watcher)
    if isinstance(done, Failed) or done.synthesis is None:
        raise ControllerError(f"{args.controller}: the search ended: {done.text if isinstance(done, Failed) else 'no result'}")
    found = done.synthesis
    try:
        durable.replace(args.output, candidates.with_parameters(controller, found.best.parameters))
    except OSError as error:
        raise UsageError(f"{args.output}: cannot be written: {error.strerror}") from None
    winner = controller_at(args.output, {})
    attempt = ledger.spend_attempt(winner.digest)
    beta = attempt_beta(profile.guarantee.beta, attempt)
    laws = profile.verification.laws
    seed = ledger.draw_seed(attempt)
    result, behaviour = run_verification(
        winner, model, profile, watcher, gap=gap, headroom=headroom, laws=laws, n=0, attempt=attempt, seed=seed, beta=beta
    )
    ledger.ended(attempt, behaviour)
    answer = {**verification_json(result), "gap_radius": gap.radius}
    if args.json:
        spent = {
            "beta_spent": ledger.spent(profile.guarantee.beta),
            "beta_left": profile.guarantee.beta - ledger.spent(profile.guarantee.beta),
        }
        output.result_json({**answer, **spent, "controller": str(args.output), **_json(found), "bounds": bounds})
    else:
        _print_search(found, bounds)
        output.out(f"the winner is in {args.output}; verified on fresh scenarios (attempt {attempt}, beta {beta:.4g}):")
        print_verification("\n".join(verification_lines(answer)))
        output.out("a certificate comes from s2r certify or s2r deploy, and costs an attempt of its own" if result.passed else "no pass")
    return 0 if result.passed else 1


def _bound(item: str) -> tuple[str, tuple[float, float]]:
    name, sign, span = item.partition("=")
    low, colon, high = span.partition(":")
    try:
        return name, (number_of(low), number_of(high)) if name and sign and colon else (float("nan"), float("nan"))
    except ValueError:
        raise UsageError(f"--bound {item}: must be NAME=LOW:HIGH") from None


def _json(found: Synthesis) -> dict[str, Any]:
    return {
        "parameters": found.best.parameters,
        "evaluations": len(found.tried),
        "search_seed": found.seed,
        "search_scenarios": found.n,
        "candidates": [msgspec.to_builtins(candidate) for candidate in found.tried],
    }


def _print_search(found: Synthesis, bounds: dict[str, tuple[float, float]]) -> None:
    output.out(f"{len(found.tried)} candidates tried, {found.n} scenarios for each law; within {_spans(bounds)}")
    output.out("the best of them (these scenarios chose them, so nothing is stated of what they show):")
    seen: list[Candidate] = []
    for candidate in sorted(found.tried, key=lambda c: c.cost):
        if len(seen) < SHOWN and candidate.parameters not in [c.parameters for c in seen]:
            seen.append(candidate)
            output.out(f"  cost {candidate.cost:8.4f}  {_values(candidate.parameters)}  {_what(candidate)}")
    output.out(f"the first, the file's own values within the bounds: cost {found.tried[0].cost:.4f}  {_what(found.tried[0])}")


def _spans(bounds: dict[str, tuple[float, float]]) -> str:
    return ", ".join(f"{name} [{low:g}, {high:g}]" for name, (low, high) in bounds.items())


def _values(parameters: dict[str, float]) -> str:
    return " ".join(f"{name}={value:.4g}" for name, value in parameters.items())


def _what(candidate: Candidate) -> str:
    if candidate.trouble:
        return candidate.trouble
    failed = ", ".join(f"{law} {share:.1%}" for law, share in candidate.failures.items())
    return f"failures: {failed}; median progress {candidate.progress:.3g}"
