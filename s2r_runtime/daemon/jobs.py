"""What a worker does: load a controller, read inputs, bound a gap, verify, trace. Each a pure function of its job (a controller's and
inputs' of their files too), so that an audit can repeat it.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec

from s2r_runtime.controllers.file import ControllerFile, load
from s2r_runtime.controllers.observing import has_history, view_of
from s2r_runtime.controllers.policy import is_policy
from s2r_runtime.daemon.given_inputs import BYTES_MAX, GivenInputs, parse_inputs
from s2r_runtime.daemon.model_store import ModelStore
from s2r_runtime.daemon.settings import facts_of, settings_of
from s2r_runtime.daemon.worker import (
    Brought,
    EnclosedCounts,
    EncloseJob,
    GapJob,
    InputsJob,
    Job,
    LoadJob,
    Model,
    ModelJob,
    Result,
    SimulateJob,
    SynthesisJob,
    TraceJob,
    VerifyJob,
)
from s2r_runtime.errors import ConfigError, ControllerError, one_line
from s2r_runtime.messages import Gap
from s2r_runtime.modelspec import dump_model, parse_model
from s2r_runtime.profile import Profile, check_model

if TYPE_CHECKING:
    from s2r_runtime.evidence.uncertain import GapSet
    from s2r_runtime.hookspecs import Task
    from s2r_runtime.models.composed import ComposedModel

Progress = Callable[[float, float, str], None]


def run(job: Job, progress: Progress) -> Result:
    """Does it. Raises S2RError with the reason where it can't be done."""
    match job:
        case LoadJob():
            if not Path(job.path).is_file():  # a device or a pipe may have no end
                raise ConfigError(f"{job.path}: is no file")
            return brought(job)
        case ModelJob():
            return Result(model=model(job))
        case GapJob():
            return Result(gap=gap(job))
        case VerifyJob():
            return verify(job, progress)
        case TraceJob():
            from s2r_runtime.daemon.trace_job import trace

            return Result(trace=trace(job, progress))
        case InputsJob():
            return Result(inputs=inputs(job))
        case SynthesisJob():
            return synthesize(job, progress)
        case SimulateJob():
            return simulate(job, progress)
        case EncloseJob():
            return enclose(job, progress)


def opened(raw: msgspec.Raw, kind: Any, what: str) -> Any:
    """A field of a request that nobody has decoded yet. Raises ConfigError."""
    try:
        return msgspec.json.decode(raw, type=kind)
    except (ValueError, RecursionError) as error:
        raise ConfigError(f"{what}: {one_line(str(error))}") from None


def brought(job: LoadJob) -> Result:
    """The controller, and the certificate that came along."""
    file = load(Path(job.path), opened(job.parameters, dict[str, float | str | bool], "parameters"))
    if job.profile is not None and is_policy(file.entry):
        _check_policy(file, job.profile)
    text = opened(job.certificate, str, "--certificate")
    if not text or job.profile is None:
        return Result(controller=file)
    return Result(controller=file, certificate=_certificate(text, job, job.profile, file.digest))


def _check_policy(file: ControllerFile, profile: Profile) -> None:
    """Starts the policy and evaluates it in one scenario, so that a network that fits neither robot nor settings costs no attempt.

    Raises ConfigError.
    """
    import numpy as np

    from s2r_runtime.controllers.batches import BatchController
    from s2r_runtime.controllers.code import Malformed
    from s2r_runtime.models.composed import compose

    model = compose(profile.model)
    task, view = task_of(profile, model), view_of(file, model)
    scenario = task.draw(np.random.default_rng(0), 1)
    x = np.asarray(scenario["start"])
    theta = view(x, task.view(scenario), first=True)
    try:
        with BatchController(file, len(model.inputs)) as control, suppress(Malformed):  # an answer in one state decides nothing
            control(x, theta)
    except ControllerError as error:
        raise ConfigError(f"{Path(file.path).parent / str(error)}") from None


def task_of(profile: Profile, model: ComposedModel) -> Task:
    """The profile's task, for this model."""
    from s2r_runtime.plugins import registry

    task: Task = registry().get("tasks", profile.task.name)(profile.task.parameters, model.nominal, model.dt)
    return task


def _certificate(text: str, job: LoadJob, profile: Profile, controller: str) -> Brought:
    from s2r_runtime.trust import certificate as certificates

    where, data = "--certificate", text.encode()
    signer = certificates.signer(data)
    try:
        found = certificates.load(data, job.keys, job.now_unix_s, where)
    except certificates.UntrustedKey as error:
        return Brought(signer, problem=str(error), untrusted=True)
    except ConfigError as error:
        return Brought(signer, problem=str(error))
    problem = certificates.assumption_problem(found, profile)
    if not problem and found.controller_digest != controller:
        problem = f"is of the controller {found.controller_digest}; the one to deploy is {controller}"
    problem = problem or certificates.fixed_seed_problem(certificates.facts(found))
    if problem:
        return Brought(signer, problem=f"{where}: {problem}")
    return Brought(signer, text, certificates.facts(found), found.gap)


def model(job: ModelJob) -> Model:
    """The model, checked with the profile's names and task, and kept. Raises ConfigError."""
    from s2r_runtime.plugins import registry

    store = ModelStore(Path(job.folder), job.base)
    text = opened(job.text, str, "adopt")
    spec = parse_model(text, job.where, "adopt") if text else store.load(job.digest)
    if spec is None:
        raise ConfigError("adopt: the proposed model is not there any more; trace again: s2r trace --live campaign")
    if spec.dt != job.profile.model.dt:
        raise ConfigError(f"adopt: model.dt is {spec.dt} s, must be the profile's {job.profile.model.dt} s")
    profile = msgspec.structs.replace(job.profile, model=spec)
    composed = check_model(profile, "adopt")
    facts = facts_of(composed, registry().get("tasks", profile.task.name)(profile.task.parameters, composed.nominal, composed.dt).horizon)
    if not facts.same_robot(job.facts):
        raise ConfigError("adopt: the model has other states or inputs than the robot's")
    try:
        kept = store.keep(spec)
    except OSError as error:
        raise ConfigError(f"adopt: the model cannot be kept: {error.strerror}") from None
    return Model(kept, spec.digest(), facts, dump_model(kept))


def gap(job: GapJob) -> Gap:
    """The gap of the profile's model on a campaign's samples; the epoch's share of beta covers both radii."""
    from s2r_runtime.evidence.gap import estimate_gap
    from s2r_runtime.models.composed import compose
    from s2r_runtime.recordings.loading import from_samples

    profile = job.profile
    model = compose(profile.model)
    return estimate_gap(
        model,
        from_samples(job.samples, rejected=job.rejected, source=f"campaign of epoch {job.epoch}"),
        epsilon=profile.guarantee.epsilon,
        beta=job.beta,
        discard=profile.guarantee.discard,
        kind=profile.norm.set,
        weights=tuple(profile.norm.weights.get(name, 1.0) for name in model.states),
        epoch=job.epoch,
    )


def verify(job: VerifyJob, progress: Progress) -> Result:
    """Rollouts of the controller on the uncertain model, under the profile's laws. The controller, code that nobody has read, answers from
    a confined process of its own.
    """
    import numpy as np

    from s2r_runtime.controllers.batches import BatchController
    from s2r_runtime.controllers.rehearsal import Kept
    from s2r_runtime.evidence import probe
    from s2r_runtime.evidence.verify import verify_in_detail

    profile, settings = job.profile, job.profile.verification
    model, task, gap_set = _asked(job)
    view = view_of(job.controller, model)
    with BatchController(job.controller, len(model.inputs)) as control:
        kept = Kept(control)
        result, details = verify_in_detail(
            kept,
            task,
            model,
            gap_set=gap_set,
            least_radius=job.least_radius,
            laws=settings.laws,
            required=settings.required,
            n=settings.n,
            epsilon=settings.epsilon,
            beta=job.beta,
            threshold=settings.threshold,
            seed=job.seed,
            attempt=job.attempt,
            controller_digest=job.controller.digest,
            task_digest=profile.task_digest(),
            progress=progress,
            view=view,
        )
    if result.passed:
        with BatchController(job.controller, len(model.inputs)) as again:
            kept.compare(again)
    behaviour = ""
    with suppress(ControllerError), BatchController(job.controller, len(model.inputs)) as probed:
        behaviour = probe.behaviour(probed, task, model, [profile.inputs[name] for name in model.inputs], view)
    lowest = -np.finfo(np.float64).max  # what `verify` counts a value that is no number as
    safety = {one.law: np.nan_to_num(one.rollouts.safety, nan=lowest, neginf=lowest, posinf=-lowest).tolist() for one in details}
    return Result(verification=result, safety=safety, behaviour=behaviour)


def _asked(job: VerifyJob | SynthesisJob | SimulateJob | EncloseJob) -> tuple[ComposedModel, Task, GapSet]:
    """The model and task of the job's profile, and the disturbances that it names."""
    from s2r_runtime.evidence.uncertain import GapSet
    from s2r_runtime.models.composed import compose

    model = compose(job.profile.model)
    return model, task_of(job.profile, model), GapSet(job.gap.set, job.gap.weights, job.radius, job.hold_radius, job.gap.hold_periods)


def synthesize(job: SynthesisJob, progress: Progress) -> Result:
    """A search over the controller's parameters; each candidate answers from a confined process of its own, as in a verification."""
    from s2r_runtime.controllers.batches import BatchController
    from s2r_runtime.evidence.synthesize import search, search_seed

    profile, settings = job.profile, job.profile.verification
    model, task, gap_set = _asked(job)
    with ExitStack() as running:

        def answering(file: ControllerFile) -> BatchController:
            running.close()  # one candidate after the other
            return running.enter_context(BatchController(file, len(model.inputs)))

        found = search(
            job.controller,
            job.bounds,
            answering,
            task,
            model,
            gap_set=gap_set,
            laws=settings.required,
            threshold=settings.threshold,
            n=job.scenarios,
            evaluations=job.evaluations,
            seed=search_seed(job.controller, gap_set, model, profile.task_digest(), job.number),
            progress=progress,
        )
    return Result(synthesis=found)


def simulate(job: SimulateJob, progress: Progress) -> Result:
    """Rollouts in the scenarios of logged runs; the controller answers from a confined process, as in a verification."""
    from s2r_runtime.controllers.batches import BatchController
    from s2r_runtime.evidence.simulated_runs import roll_out_logged

    model, task, gap_set = _asked(job)
    with BatchController(job.controller, len(model.inputs)) as control:
        found = roll_out_logged(
            control,
            task,
            model,
            gap_set,
            job.law,
            job.scenarios,
            score=job.score,
            threshold=job.profile.verification.threshold,
            rollouts=job.rollouts,
            seed=job.seed,
            progress=lambda done, total: progress(done, total, job.law),
            view=view_of(job.controller, model),
        )
    return Result(simulated=found)


def enclose(job: EncloseJob, progress: Progress) -> Result:
    """Scenarios and the tube around each nominal run; the controller answers from a confined process, as in a verification."""
    import numpy as np

    from s2r_runtime.controllers.batches import BatchController
    from s2r_runtime.controllers.linear_feedback import gain_of
    from s2r_runtime.evidence.enclosure import enclose as enclosed
    from s2r_runtime.evidence.enclosure import tube_for
    from s2r_runtime.evidence.uncertain import LAWS

    model, task, gap_set = _asked(job)
    threshold = job.profile.verification.threshold
    tube = tube_for(gain_of(job.controller), job.rate, task, model, gap_set, threshold)
    rng = np.random.default_rng([job.seed, len(LAWS)])  # a verification of this seed draws from 0, 1, ...
    view = view_of(job.controller, model)
    if has_history(job.controller):
        raise ConfigError("a policy with a history is no feedback of the state alone, so no tube of states holds its runs")
    with BatchController(job.controller, len(model.inputs)) as control:
        found = enclosed(
            lambda x, theta: control(x, view(x, theta, first=True)),
            task,
            model,
            gap_set,
            tube,
            rng,
            job.n,
            threshold=threshold,
            progress=lambda done, total: progress(done, total, "enclosure"),
        )
    return Result(enclosed=EnclosedCounts(found.failed, found.reach, found.rate_seen))


def inputs(job: InputsJob) -> GivenInputs:
    """Given inputs. Raises ConfigError if a row leaves its bounds, or where the model says that the robot would leave the geofence."""
    import numpy as np

    from s2r_runtime.gate import inside
    from s2r_runtime.models.composed import compose

    path, profile = Path(job.path), job.profile
    if not path.is_file():
        raise ConfigError(f"{path}: is no file")
    with path.open("rb") as file:
        data = file.read(BYTES_MAX + 1)
    model = compose(profile.model)
    given = parse_inputs(data, path.name, model.inputs, profile.inputs, model.dt, profile.columns)
    if not job.x:
        return given
    settings = settings_of(profile, profile.model, facts_of(model))
    x, hidden = np.array([job.x], dtype=np.float64), model.at_rest(1)
    for number, row in enumerate(given.rows):
        x, hidden = model.step(x, np.array([row]), hidden)
        if inside(settings, tuple(x[0].tolist()), settings.geofence) < 0.0:
            where = ", ".join(f"{name} {value:.3g}" for name, value in zip(model.states, x[0], strict=True))
            raise ConfigError(
                f"{path.name}: row {number + 1} of {len(given.rows)} would take the robot out of the geofence, by the model to {where}; "
                "bring it to where there is room"
            )
    return given
