"""Closed-loop runs on the robot: which count, how safe they were, what their number shows, and that a certificate can carry it."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from itertools import permutations
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from daemon_rig import Rig
from msgspec.structs import replace

from s2r_runtime import messages as m
from s2r_runtime.controllers.episodes import Episodes
from s2r_runtime.controllers.file import load
from s2r_runtime.errors import NotEnoughEvidence
from s2r_runtime.evidence.bounds import clopper_pearson_upper
from s2r_runtime.evidence.logged_deployments import Deployment, Run, _within
from s2r_runtime.evidence.seen_rows import sketch
from s2r_runtime.evidence.statements import of_trials
from s2r_runtime.evidence.trials import Found, _judged, left_out_because, read_runs, trials
from s2r_runtime.models.composed import compose
from s2r_runtime.models.unicycle import MODEL as UNICYCLE
from s2r_runtime.modelspec import EffectSpec, dump_model
from s2r_runtime.profile import load_profile
from s2r_runtime.recording.logs import read_all
from s2r_runtime.recording.reading import read
from s2r_runtime.recording.writer import Writer
from s2r_runtime.tasks.stl_task import StlTask

TASK = """name = "stl"
episodes = 6
[task.parameters]
horizon = 0.99
metric = "always (cos(theta) > 0)"
progress = "none"
start = { theta = { normal = [0.0, 0.1] } }
"""


@pytest.fixture(scope="module")
def driven(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Rig]:
    """Six scenarios of a controller that turns on the spot: half a turn in all, through headings that it was never verified at."""
    rig = Rig(tmp_path_factory.mktemp("trials"))
    text = rig.profile.read_text().replace('name = "grid_world"\n', TASK)
    rig.profile.write_text(
        text.replace("hold_periods = 5\n", "hold_periods = 5\nn = 40\n")
    )  # eight bound little, and the watch would see that
    try:
        rig.start_robot()
        rig.start()
        assert rig.sample()["exit_code"] == 0
        deployed = rig.ask("deploy", path=str(rig.controller()))
        assert deployed["exit_code"] == 0, deployed
        rig.until(lambda: rig.status()["scenarios"] >= 6)
        assert rig.stop() == 0
        yield rig
    finally:
        rig.close()


def trials_of(rig: Rig, *more: str) -> Any:
    return rig.s2r("trials", "controller.py", *map(str, rig.log_files()), "--profile", "rig.toml", "--json", *more)


def test_runs_are_judged_from_the_log_alone(driven: Rig) -> None:
    done = trials_of(driven)
    told = json.loads(done.stdout)
    seen = {o.observation.seq: o.observation.x for o in driven.messages("event/observed") if isinstance(o, m.Observed)}
    ended = [e for e in driven.messages("event/episode_ended") if isinstance(e, m.EpisodeEnded)]
    sends = {s.obs_seq: s.source for s in driven.messages("out/send") if isinstance(s, m.Send)}
    first = min(seq for seq, source in sends.items() if source == "controller")
    asked = min(a.obs_seq for a in driven.messages("out/ask") if isinstance(a, m.Ask) and a.source == "controller")
    starts = [asked + sum(e.steps for e in ended[:k]) for k in range(6)]
    whole = [k for k in range(6) if starts[k] >= first]
    safety = [min(math.cos(seen[seq][2]) for seq in range(starts[k], starts[k] + ended[k].steps + 1)) for k in whole]
    assert len(ended) == 6
    assert told["n"] == len(whole) >= 5
    assert told["worst"] == pytest.approx(min(safety))
    assert told["unsafe"] == sum(value < 0.0 for value in safety)
    assert 0 < told["unsafe"] < 6
    assert done.returncode == 1
    assert [e.safety for e in ended][whole[0] :] == pytest.approx(safety)
    measured = {x.obs_seq: x.discrepancy for x in driven.messages("event/measured") if isinstance(x, m.Measured) and not x.fault}
    assert told["radius"] == max(d for seq, d in measured.items() if starts[whole[0]] < seq <= starts[5] + ended[5].steps)
    assert told["unsafe_upper"] == pytest.approx(clopper_pearson_upper(told["unsafe"], told["n"], 0.5))
    assert told["epsilon"] == pytest.approx(1.0 - 0.5 ** (1.0 / told["n"]))


def found_in(rig: Rig, controller_digest: str, *, with_states: bool = False) -> Found:
    profile = load_profile(rig.profile)
    model = compose(profile.model)
    task = StlTask(profile.task.parameters, model.nominal, model.dt)
    return read_runs(rig.log_files(), profile, task, controller_digest, model.spec.digest(), with_states=with_states)


def test_a_number_that_was_fixed_beforehand_is_held(driven: Rig) -> None:
    digest = load(driven.folder / "controller.py").digest
    found = found_in(driven, digest)
    digests = {"controller_digest": digest, "task_digest": "t", "model_digest": "m"}
    told = trials(found, **digests, beta=0.5, fixed=2)
    assert (told.n, told.fixed, told.unsafe) == (2, True, sum(not safe for _, safe in found.counted[:2]))
    assert "their number was fixed beforehand" in of_trials(told)
    with pytest.raises(NotEnoughEvidence, match="50 are needed"):
        trials(found, **digests, beta=0.5, fixed=50)


def test_which_runs_are_the_first_does_not_depend_on_the_order_of_the_files(driven: Rig, tmp_path: Path) -> None:
    entries = [entry for path in driven.log_files() for entry in read(path)]
    paths = []
    for name, later, seed in (("z", 0, 11), ("a", 100, 12), ("m", 50, 13)):
        writer = Writer(tmp_path / f"{name}.mcap", run=name, timed=False)
        for entry in entries:
            message: Any = entry.message
            if isinstance(message, m.Started):
                settings = replace(message.settings, seed=seed)
                message = replace(message, unix_s=message.unix_s + later, settings=settings)
            writer.write(message, entry.log_time_ns)
        writer.close()
        paths.append(tmp_path / f"{name}.mcap")
    profile = load_profile(driven.profile)
    model = compose(profile.model)
    task = StlTask(profile.task.parameters, model.nominal, model.dt)
    digest, by_start = load(driven.folder / "controller.py").digest, [paths[0], paths[2], paths[1]]
    expected = read_runs(by_start, profile, task, digest, model.spec.digest())
    ends = [read_all([path]).readings[0] for path in by_start]
    assert [end.to_the_end().kind for end in ends] == ["closed"] * 3
    assert expected.heads == [end.head.hex() for end in ends]
    assert len(expected.counted) >= 6
    for given in permutations(paths):
        assert read_runs(given, profile, task, digest, model.spec.digest()) == expected


def test_runs_of_another_controller_count_for_nothing(driven: Rig) -> None:
    found = found_in(driven, "sha256:another")
    assert found.counted == []
    assert found.left_out == {"of another controller": 6}


def test_a_log_that_was_changed_gives_no_trials(driven: Rig, tmp_path: Path) -> None:
    data = bytearray(driven.log_files()[0].read_bytes())
    data[len(data) // 2] ^= 1
    (tmp_path / "changed.mcap").write_bytes(data)
    done = driven.s2r("trials", "controller.py", str(tmp_path / "changed.mcap"), "--profile", "rig.toml")
    assert done.returncode == 78
    assert "does not hold, so no trials are taken from it" in done.stderr


def test_a_certificate_of_this_controller_says_what_it_did_on_the_robot(driven: Rig) -> None:
    (log,) = map(str, driven.log_files())
    assert driven.s2r("keys", "new", "own.pem").returncode == 0
    done = driven.s2r(
        "certify",
        "controller.py",
        "--profile",
        "rig.toml",
        "--recording",
        log,
        "--trials",
        log,
        "--key",
        "own.pem",
        "-o",
        "own.cert",
        "--json",
    )
    assert done.returncode == 0, done.stdout + done.stderr
    counted = json.loads(done.stdout)["trials"]
    assert counted["unsafe"] > 0
    signed = json.loads((driven.folder / "own.cert").read_bytes())["certificate"]
    assert signed["trials"] == counted
    assert any(f"{counted['unsafe']} were unsafe" in line for line in signed["shown"])


# ---------------------------------------------------------------- what counts


def deployment(seed: int = 1) -> Deployment:
    one = StlTask({"horizon": 0.3, "metric": "always (x < 1)", "progress": "none"}, UNICYCLE, 0.1)
    return Deployment("controller", seed, "model", Episodes(one, seed))


def drive(now: Deployment, sources: list[str], x: float = 0.0, first: int = 0) -> None:
    """One observation a step; the source that answers each."""
    for seq, source in enumerate(sources, first):
        command = m.Command(seq, seq, "controller", (0.0, 0.0), seq, 1)
        _within(now, m.Proposed(seq, command), {seq: (x, 0.0, 0.0)})
        _within(now, m.Send(seq, seq, source, (0.0, 0.0), seq, 1), {})  # type: ignore[arg-type]


def judged(now: Deployment, used: set[tuple[int, int]] | None = None, threshold: float = 0.0) -> list[tuple[str, bool]]:
    taken = set[tuple[int, int]]() if used is None else used
    return [
        (left_out_because(run, now, "controller", "model", taken, threshold), run.closed or run.safety < threshold) for run in _judged(now)
    ]


CUT_SHORT = "cut short by a person or the end of the log, safe so far"
BEGAN_CLOSED = "not driven by the controller from its start"
AGAIN = "the same scenario as an earlier run (same seed)"
SEEN = dict.fromkeys(range(20), (0.0, 0.0, 0.0))


def told(now: Deployment, *messages: Any) -> None:
    for message in messages:
        _within(now, message, SEEN)


def ask(seq: int) -> m.Ask:
    return m.Ask(seq, "controller", seq)


def answer(seq: int, refused: str = "") -> list[Any]:
    """The controller's answer, the gate's verdict on it, and what the robot is told."""
    command = m.Command(seq, seq, "controller", (0.0, 0.0), seq, 1)
    verdict = m.Decided(seq, "controller", seq, seq, not refused, refused or "allowed", 0.0)
    return [m.Proposed(seq, command), verdict, send(seq, "recovery" if refused else "controller")]


def send(seq: int, source: Any) -> m.Send:
    return m.Send(seq, seq, source, (0.0, 0.0), seq, 1)


def gate(*, is_open: bool) -> m.GateChanged:
    return m.GateChanged(0, is_open, "allowed" if is_open else "radius_above_verified")


def test_a_run_in_which_the_gate_closed_is_unsafe_and_one_that_began_closed_is_left_out() -> None:
    now = deployment()
    drive(now, ["controller"] * 3 + ["controller", "recovery", "recovery"] + ["recovery", "controller", "controller"] + ["controller"])
    assert judged(now) == [
        ("", False),
        ("", True),
        ("not driven by the controller from its start", False),
        ("cut short by a person or the end of the log, safe so far", False),
    ]


def test_a_run_that_is_cut_short_counts_if_it_was_unsafe_or_the_controller_failed() -> None:
    now = deployment()
    drive(now, ["controller"] * 2, x=2.0)
    assert judged(now) == [("", True)]
    now = deployment()
    drive(now, ["controller"] * 2)
    _within(now, m.SourceStopped(9, "controller", "raised", "no idea"), {})
    assert judged(now) == [("", True)]
    now = deployment()
    drive(now, ["controller"] * 2)
    _within(now, m.SourceStopped(9, "controller", "stopped"), {})
    assert judged(now) == [("cut short by a person or the end of the log, safe so far", False)]


@pytest.mark.parametrize(
    ("threshold", "x", "expected"),
    [(0.2, 0.9, ("", True)), (-0.1, 1.05, (CUT_SHORT, False)), (-0.1, 1.2, ("", True)), (0.2, 0.7, (CUT_SHORT, False))],
)
def test_a_run_that_is_cut_short_is_held_against_the_threshold_of_the_profile(
    threshold: float, x: float, expected: tuple[str, bool]
) -> None:
    now = deployment()  # safety 1 - x so far
    drive(now, ["controller"] * 2, x=x)
    assert judged(now, threshold=threshold) == [expected]


@pytest.mark.parametrize("reason", ["raised", "died", "deadline", "malformed"])
@pytest.mark.parametrize("gate_open", [True, False])
def test_a_controller_that_fails_at_the_first_step_has_an_unsafe_run(reason: Any, gate_open: bool) -> None:
    now = deployment()
    told(now, gate(is_open=gate_open), ask(0), m.SourceStopped(0, "controller", reason, "no idea"), send(0, "recovery"))
    assert judged(now) == [("", True)]


def test_a_failure_at_the_first_step_is_of_that_run_and_not_of_the_one_before() -> None:
    now = deployment()
    told(now, gate(is_open=True))
    for seq in range(3):
        told(now, ask(seq), *answer(seq))
    told(now, ask(3), m.SourceStopped(3, "controller", "died"), send(3, "recovery"))
    assert judged(now) == [("", False), ("", True)]


def test_a_first_command_that_the_gate_refuses_makes_an_unsafe_run_unless_the_gate_had_not_opened() -> None:
    for why, expected in (("input_out_of_bounds", ("", True)), ("outside_region", ("", True)), ("settling", (BEGAN_CLOSED, False))):
        now = deployment()
        told(now, ask(0), *answer(0, refused=why))
        assert judged(now) == [expected], why


def test_a_gate_that_closes_before_the_first_answer_makes_an_unsafe_run_and_the_late_answer_is_no_step() -> None:
    now = deployment()
    told(now, gate(is_open=True), ask(0), gate(is_open=False), send(0, "recovery"), *answer(0, refused="command_out_of_order")[:2])
    assert judged(now) == [("", True)]
    assert now.episodes.look(np.zeros(3))[1].k == 1


def test_scenarios_of_one_seed_count_once() -> None:
    used: set[tuple[int, int]] = set()
    again = []
    for seed in (1, 1, 2):
        now = deployment(seed)
        drive(now, ["controller"] * 4)
        again.append(judged(now, used)[0][0])
    assert again == ["", "the same scenario as an earlier run (same seed)", ""]


def test_a_scenario_whose_first_run_was_left_out_is_not_run_again_until_it_counts() -> None:
    for first, why in ((["controller"] * 2, CUT_SHORT), (["recovery"] * 2, BEGAN_CLOSED)):
        used: set[tuple[int, int]] = set()
        now = deployment()
        drive(now, first)
        assert judged(now, used) == [(why, False)]
        now = deployment()
        drive(now, ["controller"] * 4)
        assert judged(now, used)[0] == (AGAIN, False)
    used = set()
    now = deployment()
    drive(now, ["controller"] * 4)
    assert left_out_because(next(_judged(now)), now, "controller", "another model", used, 0.0) == "measured against another model"
    assert judged(now, used)[0] == (AGAIN, False)
    assert not left_out_because(next(_judged(now)), now, "controller", "model", set(), 0.0)


def test_299_safe_runs_show_one_percent_at_most() -> None:
    found = Found([(Run(i, 4 * i, 4 * i + 3, 0.5 + i, discrepancy=0.001 * (i % 7)), True) for i in range(299)])
    digests = {"controller_digest": "c", "task_digest": "t", "model_digest": "m"}
    told = trials(found, **digests, beta=0.05)
    assert told.unsafe_upper <= 0.01
    assert told.epsilon == pytest.approx(told.unsafe_upper)
    assert (told.worst, told.radius) == (0.5, 0.006)
    assert "Of 299 closed-loop runs" in of_trials(told)
    with pytest.raises(NotEnoughEvidence, match="1 are needed"):
        trials(Found(), **digests, beta=0.05)


def test_both_bounds_of_trials_keep_their_confidence() -> None:
    """n runs from a known law, 4000 times: misses at most beta (exact lower limit of 99.9 %)."""
    from s2r_runtime.evidence.bounds import clopper_pearson_lower

    rng, repetitions, n, beta, p = np.random.default_rng(5), 4000, 60, 0.1, 0.07
    digests = {"controller_digest": "c", "task_digest": "t", "model_digest": "m"}
    missed = np.zeros(2, dtype=int)
    for _ in range(repetitions):
        unsafe, d = rng.random(n) < p, rng.random(n)
        found = Found(
            [(Run(i, i, i, -1.0 if bad else 1.0, discrepancy=float(v)), not bad) for i, (bad, v) in enumerate(zip(unsafe, d, strict=True))]
        )
        told = trials(found, **digests, beta=beta)
        missed += [told.unsafe_upper < p, 1.0 - told.radius > told.epsilon]
    for count in missed:
        assert clopper_pearson_lower(int(count), repetitions, 1e-3) <= beta
    assert missed[1] > 0.5 * beta * repetitions


def test_a_controller_before_and_after_an_update_is_compared_run_by_run(driven: Rig) -> None:
    """The same logs on both sides: every scenario has its partner, and nothing is shown."""
    logs = [str(path) for path in driven.log_files()]
    sides = [*(word for path in logs for word in ("--a-log", path)), *(word for path in logs for word in ("--b-log", path))]
    done = driven.s2r("compare", "controller.py", "controller.py", "--profile", "rig.toml", "--json", *sides)
    found = json.loads(done.stdout)
    counted = json.loads(trials_of(driven).stdout)
    assert (done.returncode, found["answer"]) == (3, "undecided")
    assert found["n"] == found["agree"] == counted["n"]
    assert found["a"] == pytest.approx(1.0 - counted["unsafe"] / counted["n"])
    assert found["pair"] == "scenario"
    one = driven.s2r("compare", "controller.py", "controller.py", *logs, "--profile", "rig.toml")
    assert (one.returncode, "are one controller: say which logs are before" in one.stderr) == (2, True)


@pytest.mark.slow
def test_runs_in_logs_are_compared_by_the_safety_value_too(driven: Rig) -> None:
    logs = [str(path) for path in driven.log_files()]
    sides = [*(word for path in logs for word in ("--a-log", path)), *(word for path in logs for word in ("--b-log", path))]
    values = driven.s2r(
        "compare", "controller.py", "controller.py", "--profile", "rig.toml", "--json", "--score", "safety", "--range", "-1", "1", *sides
    )
    assert json.loads(values.stdout)["a"] == pytest.approx(np.mean([run.safety for run, _ in found_in(driven, digest_in(driven)).counted]))


def digest_in(rig: Rig) -> str:
    return load(rig.folder / "controller.py").digest


# ---------------------------------------------------------------- with simulation


@pytest.mark.slow
def test_runs_are_rolled_out_again_in_their_own_scenarios(driven: Rig) -> None:
    done = driven.s2r("trials", "controller.py", *map(str, driven.log_files()), "--profile", "rig.toml", "--json", "--simulate", "4")
    found = json.loads(done.stdout)
    simulated = found["simulated"]
    safe = 1.0 - found["unsafe"] / found["n"]
    assert (simulated["score"], simulated["rollouts"], simulated["law"], simulated["radius"]) == ("safe", 4, "uniform", 0.0)
    assert simulated["mean"]["n"] == simulated["optimism"]["n"] == found["n"]
    assert simulated["mean"]["lower"] <= safe <= simulated["mean"]["upper"]
    assert simulated["optimism"]["lower"] <= simulated["optimism"]["mean"] <= simulated["optimism"]["upper"]
    assert "Mean with simulation (G11)." in found["statement"]
    assert "Optimism (G12)." in found["statement"]


@pytest.mark.slow
def test_the_model_is_exact_where_its_rollouts_repeat_the_runs(driven: Rig) -> None:
    """The rig's robot is the model with little noise: in the run's own scenario it turns as far, in another one as well."""
    arguments = ("--profile", "rig.toml", "--json", "--simulate", "2", "--score", "safety", "--range", "-1", "1")
    found = json.loads(driven.s2r("trials", "controller.py", *map(str, driven.log_files()), *arguments).stdout)
    counted = found_in(driven, digest_in(driven)).counted
    simulated = found["simulated"]
    assert simulated["optimism"]["mean"] == pytest.approx(0.0, abs=0.25)
    real = np.mean([run.safety if not run.closed else -1.0 for run, _ in counted])
    assert simulated["mean"]["lower"] <= real <= simulated["mean"]["upper"]
    again = json.loads(driven.s2r("trials", "controller.py", *map(str, driven.log_files()), *arguments).stdout)
    assert again["simulated"] == simulated


def test_what_is_rolled_out_needs_a_number_of_rollouts(driven: Rig) -> None:
    done = driven.s2r("trials", "controller.py", *map(str, driven.log_files()), "--profile", "rig.toml", "--radius", "0.1")
    assert (done.returncode, "go with --simulate M" in done.stderr) == (2, True)


@pytest.mark.slow
def test_a_profile_that_demands_a_limit_of_the_optimism_gets_no_certificate_without_it(driven: Rig) -> None:
    (log,) = map(str, driven.log_files())
    text = driven.profile.read_text()
    start = ("certify", "controller.py", "--recording", log, "--key", "own.pem", "-o", "demanding.cert", "--json")
    assert (driven.folder / "own.pem").exists() or driven.s2r("keys", "new", "own.pem").returncode == 0
    for most, more, code, line in (
        (0.9, (), 3, "nothing is known of the model's optimism on this task"),
        (0.01, ("--trials", log), 3, "is shown to exceed the robot's by at most"),
        (0.99, ("--trials", log), 0, ""),
    ):
        demanding = (
            text + f"\n[verification]\nmax_optimism = {most}\n"
            if "[verification]" not in text
            else text.replace("[verification]", f"[verification]\nmax_optimism = {most}")
        )
        (driven.folder / "demanding.toml").write_text(demanding)
        assert load_profile(driven.folder / "demanding.toml").digest() != load_profile(driven.profile).digest()
        done = driven.s2r(*start, "--profile", "demanding.toml", *more)
        assert done.returncode == code, done.stdout + done.stderr
        assert line in done.stderr
        assert ("no attempt was spent" in done.stderr) == (code == 3)
        if more:
            runs = driven.s2r("trials", "controller.py", log, "--profile", "demanding.toml", "--simulate", "20")
            assert ("max_optimism    met" in runs.stdout, "max_optimism    not met: the model's" in runs.stdout) == (code == 0, code == 3)
    signed = json.loads((driven.folder / "demanding.cert").read_bytes())["certificate"]
    assert signed["trials"]["simulated"]["rollouts"] == 20
    assert any(one.startswith("Optimism (G12).") for one in signed["shown"])


@pytest.mark.slow
def test_runs_are_rolled_out_on_a_repaired_model_unless_it_was_fitted_on_them(driven: Rig) -> None:
    runs = [run for run, _ in found_in(driven, digest_in(driven), with_states=True).counted]
    assert [run.states[0] for run in runs] == [run.start for run in runs]
    assert all(not run.states for run, _ in found_in(driven, digest_in(driven)).counted)
    given = load_profile(driven.profile).model
    slower = replace(given, effects=(*given.effects, EffectSpec("input_gain", "w", {"gain": 0.5})))
    arguments = ("trials", "controller.py", *map(str, driven.log_files()), "--profile", "rig.toml", "--json", "--simulate", "2")
    scored = (*arguments, "--score", "safety", "--range", "-1", "1")
    rows = sketch([np.array(run.states) for run in runs], compose(given).angle_columns)
    for name, model in (("slower", slower), ("fitted", replace(slower, fitted_on=rows))):
        (driven.folder / f"{name}.toml").write_text(dump_model(model))
    before = json.loads(driven.s2r(*scored).stdout)["simulated"]["optimism"]["mean"]
    after = json.loads(driven.s2r(*scored, "--on", "slower.toml").stdout)["simulated"]["optimism"]["mean"]
    assert after > before + 0.1  # it turns half as far, so it stays nearer to where it is safe
    refused = driven.s2r(*scored, "--on", "fitted.toml")
    assert (refused.returncode, "was fitted on rows of these runs" in refused.stderr) == (78, True)
