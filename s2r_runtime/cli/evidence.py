"""Verbs about evidence: gap (is the model right) and verify (is the controller)."""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec

from s2r_runtime.cli import output
from s2r_runtime.cli.choices import (
    add_limit,
    add_model_options,
    add_signal_options,
    chosen_model,
    columns_of,
    controller_at,
    count,
    load_checked,
    not_negative,
    positive,
    probability,
    signals_of,
    transport_of,
    weights_of,
)
from s2r_runtime.errors import NotEnoughEvidence, RecordingError, UsageError

if TYPE_CHECKING:
    from s2r_runtime.controllers.hosted import ControllerFile
    from s2r_runtime.daemon.worker import Failed, Job, Result
    from s2r_runtime.messages import Gap, Verification
    from s2r_runtime.models.composed import ComposedModel
    from s2r_runtime.profile import Profile
    from s2r_runtime.recordings.table_rows import Subset
    from s2r_runtime.recordings.transitions import Transitions

LAWS = ("uniform", "persistent", "adversarial")


def add(verbs: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Adds the verbs of this module."""
    gap = verbs.add_parser("gap")
    gap.add_argument(
        "recording",
        type=Path,
        nargs="+",
        metavar="RECORDING",
        help="a campaign's MCAP, CSV (.gz), or somebody else's format (docs/recordings.md); several of one kind count together",
    )
    add_model_options(gap)
    add_signal_options(gap)
    gap.add_argument("--epsilon", type=probability, metavar="E", help="violation probability (default: the profile's, else 0.01)")
    gap.add_argument("--beta", type=probability, metavar="B", help="one minus the confidence (default 0.05)")
    gap.add_argument("--discard", type=count, metavar="K", help="largest discrepancies to leave out, fixed beforehand (default 0)")
    gap.add_argument("--set", choices=("ball", "box"), help="shape of the gap set (default: the profile's, else ball)")
    gap.add_argument("--weight", action="append", default=[], metavar="STATE=W", help="weight of a state in the norm; may be repeated")
    gap.add_argument(
        "--blocking",
        type=positive,
        metavar="S",
        help="ordinary driving: assume that transitions S seconds apart are independent; the assumption stands in the statement",
    )
    gap.add_argument("--json", action="store_true", help="print one JSON object")
    gap.set_defaults(run=run_gap)

    verify = verbs.add_parser("verify")
    verify.add_argument("controller", type=Path, metavar="CONTROLLER", help="a Python file with control(x, theta, parameters)")
    verify.add_argument("--profile", type=Path, required=True, metavar="P", help="the robot's profile (TOML)")
    verify.add_argument("--model", metavar="MODEL.toml", help="a repaired model instead of the profile's")
    size = verify.add_mutually_exclusive_group(required=True)
    size.add_argument("--radius", type=not_negative, metavar="R", help="radius of the gap set (0: the model as it is)")
    size.add_argument(
        "--recording", type=Path, action="append", metavar="REC", help="take radius and hold gap from this campaign; may be repeated"
    )
    verify.add_argument(
        "--hold-radius",
        type=positive,
        metavar="R",
        help="hold gap for the persistent law (with --radius; default: the radius times sqrt(hold periods))",
    )
    verify.add_argument(
        "--headroom",
        type=positive,
        metavar="H",
        help="look for the largest radius, up to H times, at which it passes (default: the profile's with --recording, else 1)",
    )
    verify.add_argument("-n", type=count, default=0, metavar="N", help="scenarios for each law (default: what beta asks for)")
    verify.add_argument(
        "--law",
        action="append",
        choices=LAWS,
        metavar="L",
        help=f"disturbance law: {', '.join(LAWS)}; may be repeated (default: the profile's)",
    )
    verify.add_argument("--param", action="append", default=[], metavar="K=V", help="a parameter of the controller; may be repeated")
    add_limit(verify)
    verify.add_argument("--json", action="store_true", help="print one JSON object")
    verify.set_defaults(run=run_verify)


def run_gap(args: argparse.Namespace) -> int:
    """Exit 0 with a statement, 3 if the data do not carry one (the numbers are printed all the same)."""
    from s2r_runtime.evidence import gap as gaps
    from s2r_runtime.files.table_text import limits_of
    from s2r_runtime.messages import NOT_INDEPENDENT, REPEATED
    from s2r_runtime.recordings.loading import load_transitions

    model, profile = chosen_model(args)
    columns, signals = columns_of(args, model, profile, *args.recording), signals_of(args, model)
    transport, bar = transport_of(args, profile), output.Progress("reading")
    limits = limits_of(args.max_gb)
    try:
        found = load_transitions(args.recording, model, columns, transport=transport, signals=signals, limits=limits, progress=bar)
    finally:
        bar.close()
    output.notes(found.source, found.notes)
    if args.blocking:
        found = gaps.blocked(found, args.blocking, model.dt)
    result = gaps.estimate_gap(
        model,
        found,
        epsilon=args.epsilon or (profile.guarantee.epsilon if profile else 0.01),
        beta=args.beta or (profile.guarantee.beta if profile else 0.05),
        discard=args.discard if args.discard is not None else (profile.guarantee.discard if profile else 0),
        kind=args.set or (profile.norm.set if profile else "ball"),
        weights=weights_of(model.states, args.weight, profile),
    )
    # of a table nobody can say in which order its segments were drawn: there it stands in the statement
    found = gaps.doubted(result, found, NOT_INDEPENDENT if found.samples_digest else (REPEATED,))
    answer = gaps.gap_json(result, found, model.states)
    if args.json:
        output.result_json(answer)
    else:
        _print_gap(answer, found.subset)
    return 0 if found.independent else 3


def _print_gap(answer: dict[str, Any], subset: Subset | None) -> None:
    output.out(f"gap radius      {answer['radius']:.6g}   (unweighted norm: {answer['radius_literal']:.6g})")
    if answer["hold_periods"] > 1:
        output.out(f"hold gap        {answer['hold_radius']:.6g} over {answer['hold_periods']} periods")
    if answer.get("radius_noise"):
        from s2r_runtime.evidence.gap import noise_share

        output.out(f"noise alone     would make about {noise_share(answer['radius_noise'], answer['radius'])} of it")
    output.out(f"transitions     {answer['n']}, {answer['discarded']} discarded, rejected: {answer['rejected'] or 'none'}")
    if subset is not None:
        output.out(f"subset          {subset.text()}")
    weights = ", ".join(f"{name} {weight:g}" for name, weight in answer["weights"].items())
    output.out(f"norm            {answer['set']}, weights {weights}")
    output.out("residual        " + ("white" if answer["white"] else f"not white: {answer['white_reason']}"))
    output.out(answer["statement"])


def run_verify(args: argparse.Namespace) -> int:
    """Exit 0 if it passed, 1 if it did not."""
    from s2r_runtime.evidence import verify as verification

    profile = load_checked(args.profile)
    model = profile_model(args, profile)
    epoch_gap = gap_of(load_recordings(args.recording, model, profile, args.max_gb)[0], model, profile)[0] if args.recording else None
    laws = tuple(args.law) if args.law else profile.verification.laws
    gap = epoch_gap or gap_at(args.radius, args.hold_radius, model, profile)
    headroom = args.headroom or (profile.verification.headroom if epoch_gap else 1.0)
    if headroom < 1.0:
        raise UsageError(f"--headroom {headroom:g}: must be >= 1")
    controller = controller_at(args.controller, args.param)
    seed = verification.seed_for(controller.digest, model.spec.digest(), profile.task_digest(), 1)
    result, _ = run_verification(
        controller, model, profile, gap=gap, headroom=headroom, laws=laws, n=args.n, attempt=1, seed=seed, beta=profile.guarantee.beta
    )
    answer = {**verification.verification_json(result), "gap_radius": gap.radius}
    if args.json:
        output.result_json(answer)
    else:
        print_verification(answer)
    return 0 if result.passed else 1


def gap_at(radius: float, hold_radius: float | None, model: ComposedModel, profile: Profile) -> Gap:
    """A gap of that radius that nobody measured: for `--radius`."""
    from s2r_runtime.messages import Gap

    periods = profile.sampling.hold_periods
    return Gap(
        radius=radius,
        radius_literal=radius,
        hold_radius=hold_radius or radius * periods**0.5,
        hold_periods=periods,
        set=profile.norm.set,
        weights=weights_of(model.states, [], profile),
        n=0,
        discarded=0,
        epsilon=profile.guarantee.epsilon,
        beta=profile.guarantee.beta,
        epoch=0,
        model_digest=model.spec.digest(),
        transitions_digest="",
    )


def profile_model(args: argparse.Namespace, profile: Profile) -> ComposedModel:
    """The profile's model, or the one named by --model in its place."""
    from s2r_runtime.models.composed import compose
    from s2r_runtime.modelspec import load_model

    if getattr(args, "model", None):
        return compose(load_model(Path(args.model)), args.model)
    return compose(profile.model, f"{args.profile}: model")


def load_recordings(
    paths: Sequence[Path],
    model: ComposedModel,
    profile: Profile,
    max_gb: float | None = None,
) -> tuple[Transitions, str]:
    """The transitions of the recordings, and the digest of all. Of several drives the first blocks count: which ones those are may not
    depend on the order in which a person names them, so several are digested first. max_gb: of one recording. Raises as
    `load_transitions`.
    """
    from s2r_runtime.files.canonical import digest_of_all, digest_of_path
    from s2r_runtime.files.table_text import limits_of
    from s2r_runtime.recordings.loading import load_transitions, look_at

    limits, digests, ordered = limits_of(max_gb), [], list(paths)
    for path in paths:
        look_at(path, limits)
    if len(paths) > 1:
        try:
            digested = sorted((digest_of_path(path), path) for path in paths)
        except OSError as error:
            raise RecordingError(f"{error.filename}: cannot be read: {error.strerror}") from None
        digests, ordered = [digest for digest, _ in digested], [path for _, path in digested]
    found = load_transitions(ordered, model, dict(profile.columns), transport=profile.transport, limits=limits)
    output.notes(found.source, found.notes)
    return found, digest_of_all(digests or [found.digest])


def gap_of(
    found: Transitions,
    model: ComposedModel,
    profile: Profile,
    *,
    beta: float | None = None,
    epoch: int = 1,
) -> tuple[Gap, str, str]:
    """The gap that a campaign shows under the profile's settings, or driving that the profile vouches for; the assumption that it rests on;
    and which period of each hold gave the sample. beta: the epoch's share; without one the gap founds no certificate. Raises
    NotEnoughEvidence if it carries no statement.
    """
    from s2r_runtime.evidence import gap as gaps
    from s2r_runtime.messages import NOT_INDEPENDENT, REPEATED

    share = beta or profile.guarantee.beta
    if found.drive is not None and profile.driving.block > 0.0:
        from s2r_runtime.evidence import blocked

        epsilon, discard = profile.guarantee.epsilon, profile.guarantee.discard
        angles = model.angle_columns
        found = blocked.founding(found, profile.driving, model.dt, epsilon=epsilon, share=share, discard=discard, angles=angles)
    if not found.independent:
        raise NotEnoughEvidence(
            f"{found.source}: is ordinary driving, not a campaign; its transitions are not independent, so its gap carries no statement, "
            "unless the profile vouches for blocks of it: [driving]"
        )
    gap = gaps.estimate_gap(
        model,
        found,
        epsilon=profile.guarantee.epsilon,
        beta=share,
        discard=profile.guarantee.discard,
        kind=profile.norm.set,
        weights=weights_of(model.states, [], profile),
        epoch=epoch,
    )
    told = gaps.doubted(gap, found, (REPEATED,) if beta is None else NOT_INDEPENDENT)
    if told is not found:
        raise NotEnoughEvidence(f"{found.source}: {told.doubt}; its gap carries no statement")
    return gap, found.assumption, "first" if found.holds is None else found.holds.law


def run_verification(
    controller: ControllerFile,
    model: ComposedModel,
    profile: Profile,
    *,
    gap: Gap,
    headroom: float,
    laws: tuple[str, ...],
    n: int,
    attempt: int,
    seed: int,
    beta: float,
) -> tuple[Verification, str]:
    """Verification at the largest radius from the gap's to `headroom` times it at which the controller passes. In a worker process: the
    controller's code runs confined, silenced, and for a limited time.

    A controller that ends the worker or outlasts `verification.timeout` has not passed, with that as the reason. Also returns its
    behaviour (`probe`), or an empty text.
    """
    from s2r_runtime import messages
    from s2r_runtime.core.headroom import grid
    from s2r_runtime.daemon.worker import Failed, Result, VerifyJob
    from s2r_runtime.evidence.bounds import sample_size

    # laws asked for by name are what the question is about, even where the profile does not require them
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
    asked = msgspec.structs.replace(profile, model=model.spec, verification=settings)
    job = VerifyJob(asked, controller, gap, most, headroom * gap.hold_radius, attempt, seed, beta, gap.radius)
    done = work(job, settings.timeout, "verifying")
    if isinstance(done, Result) and done.verification is not None:
        return done.verification, done.behaviour
    failed = messages.Verification(
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


def work(job: Job, timeout_s: float, label: str) -> Result | Failed:
    """What a worker process makes of the job; progress on a terminal."""
    from s2r_runtime.daemon.worker import Progress, Worker

    bar = output.Progress(label)
    worker = Worker(job, timeout_s)
    try:
        while True:
            for message in worker.poll(time.monotonic_ns()):
                if isinstance(message, Progress):
                    bar(message.done, message.total, message.detail)
                else:
                    return message
            time.sleep(0.01)
    finally:
        worker.stop()
        bar.close()


def print_verification(answer: dict[str, Any]) -> None:
    """The account that a person reads."""
    why = f": {answer['reason']}" if answer.get("reason") else ""
    output.out(output.styled("passed", "green") if answer["passed"] else output.styled("not passed", "red") + why)
    if answer["passed"] and "gap_radius" in answer and answer["split"] > 1:
        output.out(f"gap {answer['gap_radius']:.4g}, verified to {answer['radius']:.4g}")
    for law, r in answer["laws"].items():
        failures = f"failures {r['failures']} (at most {r['failure_upper']:.2%})"
        note = "" if r["required"] else "  (reported, not required)"
        output.out(f"  {law:12s} {r['n']:6d} scenarios  s* {r['s_star']:+.4f}  {failures}  progress {r['progress']:.3f}{note}")
    output.out(answer["statement"])
    for line in answer["not_shown"] if answer["passed"] else ():
        output.out(f"  not shown: {line}")
