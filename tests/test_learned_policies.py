"""Learned policies: an ONNX file and its settings are a controller like any other, and bad ones are one line (docs/learned-policies.md)."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from controllers_rig import Hosted

pytest.importorskip("onnxruntime")
onnx = pytest.importorskip("onnx")

from onnx_rig import EXAMPLE, external, linear, tables, write  # noqa: E402

import s2r_runtime as s2r  # noqa: E402
from s2r_runtime.controllers import policy  # noqa: E402
from s2r_runtime.controllers.batches import BatchController  # noqa: E402
from s2r_runtime.controllers.code import Malformed  # noqa: E402
from s2r_runtime.controllers.confinement import ALL  # noqa: E402
from s2r_runtime.controllers.file import ControllerFile, load  # noqa: E402
from s2r_runtime.controllers.hosted import Ready, Reply  # noqa: E402
from s2r_runtime.controllers.observing import view_of  # noqa: E402
from s2r_runtime.errors import ConfigError, UsageError  # noqa: E402
from s2r_runtime.evidence.uncertain import GapSet, roll_out  # noqa: E402
from s2r_runtime.models.composed import compose  # noqa: E402
from s2r_runtime.modelspec import ModelSpec  # noqa: E402
from s2r_runtime.plugins import registry  # noqa: E402
from s2r_runtime.profile import TaskChoice  # noqa: E402

GRID_PROFILE = EXAMPLE / "grid.toml"
MODEL = compose(ModelSpec("unicycle", 0.033))
TURN = np.array([[0.0, 0.1], [0.1, 0.0], [0.0, 0.0]])
KEEP_OUT = TaskChoice("keep_out", {})


def answers(path: Path, x: Any, theta: dict[str, Any] | None = None) -> Any:
    """u of a policy in its own process, for the states of one step."""
    file = load(path)
    with BatchController(file, 2) as control:
        return control(np.array(x), view_of(file, MODEL)(np.array(x), theta or {}, first=True))


# ---------------------------------------------------------------- what is a policy


def test_digest_covers_network_settings_and_library_but_no_comment(tmp_path: Path) -> None:
    first = load(write(tmp_path, linear(TURN)))
    assert load(write(tmp_path, linear(TURN), tables() + "# a comment\n")).digest == first.digest
    changed = TURN.copy()
    changed[0, 0] = np.nextafter(np.float32(0), np.float32(1))
    others = [
        load(write(tmp_path, linear(changed))),
        load(write(tmp_path, linear(TURN), tables(each="scale = 1.0000000000000002"))),
        load(write(tmp_path, linear(TURN), tables(top="history = 2"))),
        load(write(tmp_path, linear(TURN), tables(("y", "x", "theta")))),
        load(write(tmp_path, linear(TURN), tables(limits="lower = -0.2\nupper = 0.21"))),
        msgspec.structs.replace(first, libraries={**first.libraries, "onnxruntime": "1.0"}),
    ]
    assert len({first.digest, *(other.digest for other in others)}) == 7
    assert set(first.libraries) == {"numpy", "onnxruntime"}
    assert msgspec.json.decode(msgspec.json.encode(first), type=ControllerFile).digest == first.digest


def test_observations_are_scaled_clipped_and_outputs_limited(tmp_path: Path) -> None:
    settings = """
[[observations]]
name = "goal"
offset = [1.0, 2.0]
scale = [2.0, 0.5]
clip = 3.0
[[observations]]
name = "x"
offset = 0.5
[[outputs]]
name = "v"
scale = 10.0
offset = 0.25
lower = -1.0
upper = 1.0
[[outputs]]
name = "w"
lower = -9.0
upper = 9.0
"""
    path = write(tmp_path, linear([[0.1, 0.0], [0.0, 1.0], [0.0, 1.0]]), settings)
    goal = np.array([[1.5, 2.0], [1.0, np.inf], [-99.0, 1.0]])
    u = answers(path, [[0.5, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 0.0]], {"goal": goal})
    np.testing.assert_allclose(u, [[0.5, 0.0], [0.25, 3.5], [-1.0, -2.5]], rtol=1e-6)


@pytest.mark.parametrize("shape", [["n", 3, 1], ["n", 3]])
def test_history_begins_with_the_first_observation_and_moves_on(tmp_path: Path, shape: list[Any]) -> None:
    """The network's output is the oldest of three observations, in either form of its input."""
    model = linear([[1.0, 0.0], [0.0, 0.0], [0.0, 1.0]], shape=["n", 3])
    if len(shape) == 3:
        model.graph.node.insert(0, onnx.helper.make_node("Flatten", ["z"], ["flat"]))
        model.graph.node[1].input[0] = "flat"
        model.graph.input[0].type.tensor_type.shape.dim.add().dim_value = 1
    path = write(tmp_path, model, tables(("x",), top="history = 3", limits="lower = -9.0\nupper = 9.0"))
    file, first = load(path), []
    view = view_of(file, MODEL)
    with BatchController(file, 2) as control:
        for k, x in enumerate((1.0, 2.0, 3.0, 4.0)):
            state = np.array([[x, 0.0, 0.0]])
            first.append(control(state, view(state, {}, first=k == 0))[0].tolist())
        state = np.array([[7.0, 0.0, 0.0]])
        first.append(control(state, view(state, {}, first=True))[0].tolist())
    assert first == [[1.0, 1.0], [1.0, 2.0], [1.0, 3.0], [2.0, 4.0], [7.0, 7.0]]


# ---------------------------------------------------------------- the same numbers everywhere


def test_one_row_on_the_robot_is_the_row_of_a_batch_bit_for_bit(tmp_path: Path) -> None:
    file, task = load(EXAMPLE / "grid_policy.onnx"), registry().get("tasks", "grid_world")({"movers": 0}, MODEL.nominal, MODEL.dt)
    scenario = task.draw(np.random.default_rng(3), 299)
    x = np.asarray(scenario["start"])
    theta = view_of(file, MODEL)(x, task.view(scenario), first=True)
    with BatchController(file, 2) as control, BatchController(file, 2) as other:
        together = control(x, theta)
        for k in range(0, 299, 7):
            alone = other(x[k : k + 1], {name: value[k : k + 1] for name, value in theta.items()})
            np.testing.assert_array_equal(alone[0], together[k])


def test_network_with_a_fixed_number_of_rows_answers_any_number(tmp_path: Path) -> None:
    x = np.random.default_rng(1).normal(size=(7, 3)) * 0.1
    fixed = answers(write(tmp_path, linear(TURN, rows=1)), x)
    np.testing.assert_array_equal(fixed, answers(write(tmp_path, linear(TURN, rows=3)), x))
    np.testing.assert_allclose(fixed, x @ TURN, rtol=1e-5, atol=1e-9)


def test_network_in_double_precision_runs_in_it(tmp_path: Path) -> None:
    x = np.array([[1e-9, 0.1, 0.0], [0.1, 1e-9, 0.0]])
    np.testing.assert_allclose(answers(write(tmp_path, linear(TURN, kind=onnx.TensorProto.DOUBLE)), x), x @ TURN, rtol=1e-15)


def test_hosted_policy_sees_the_history_that_it_was_verified_with(tmp_path: Path) -> None:
    """The states that a rollout passes through are shown to the hosted policy: it must answer as it did there."""
    weights = np.array([[0.3, -0.5], [0.1, 0.2], [-0.2, 0.4], [0.05, 0.3]])
    file = load(write(tmp_path, linear(weights), tables(("x", "theta"), top="history = 2")))
    task = registry().get("tasks", "keep_out")({}, MODEL.nominal, MODEL.dt)
    gap, shown = GapSet("ball", (1.0, 1.0, 1.0), 0.0), []

    def noted(x: Any, theta: Any) -> Any:
        shown.append((x[0].tolist(), control(x, theta)[0].tolist()))
        return control(x, theta)

    with BatchController(file, 2) as control:
        roll_out(noted, task, MODEL, gap, "uniform", np.random.default_rng(1), 3, view=view_of(file, MODEL))
    hosted = Hosted(file, KEEP_OUT)
    try:
        assert isinstance(hosted.next(), Ready)
        for x, u in shown[:25]:
            reply = hosted.ask(tuple(x))
            assert isinstance(reply, Reply), reply
            assert list(reply.u) == u
    finally:
        hosted.host.close()


def test_policy_is_confined_as_any_controller_and_computes_in_one_thread(tmp_path: Path) -> None:
    python = tmp_path / "still.py"
    python.write_text("def control(x, theta, parameters):\n    return x[:, :2] * 0\n")
    with BatchController(load(python), 2) as other, BatchController(load(write(tmp_path, linear(TURN))), 2) as control:

        def others_ran_ns() -> int:
            tasks = [task for task in Path(f"/proc/{control.pid}/task").iterdir() if task.name != str(control.pid)]
            return sum(int((task / "schedstat").read_text().split()[0]) for task in tasks)

        before = others_ran_ns()
        for _ in range(100):
            control(np.zeros((400, 3)), {name: np.zeros((400, 1, 1)) for name in ("x", "y", "theta")})
        assert others_ran_ns() == before  # onnxruntime starts a thread, which sleeps
        assert control.contained == other.contained
        assert {"memory", "files", "privileges"} <= set(control.contained) <= set(ALL)
        seccomp = Path(f"/proc/{control.pid}/status").read_text().partition("Seccomp:\t")[2][0]
        assert seccomp == ("2" if "system_calls" in control.contained else "0")


# ---------------------------------------------------------------- files that are wrong


def _sparse(folder: Path) -> Path:
    path = write(folder, linear(TURN))
    os.truncate(path, 2 << 30)
    return path


def _cut(folder: Path) -> Path:
    return write(folder, linear(TURN).SerializeToString()[:-7])


def _alone(folder: Path) -> Path:
    path = write(folder, linear(TURN))
    path.with_suffix(".toml").unlink()
    return path


BAD_FILES: dict[str, tuple[Callable[[Path], Path], str]] = {
    "text": (lambda f: write(f, b"import torch\n"), "policy.onnx: is no ONNX model: "),
    "empty": (lambda f: write(f, b""), "policy.onnx: is no ONNX model: it has no graph"),
    "zeros": (lambda f: write(f, bytes(1000)), "policy.onnx: is no ONNX model: "),
    "cut": (_cut, "policy.onnx: is no ONNX model: it is cut short"),
    "2 GB": (_sparse, "policy.onnx: has more than 16777216 bytes"),
    "external data": (external, "policy.onnx: a tensor's values are in another file"),
    "no settings": (_alone, "policy.toml: no such file; policy.onnx needs its observations"),
    "not TOML": (lambda f: write(f, linear(TURN), "history = "), "policy.toml: not TOML"),
    "unknown key": (lambda f: write(f, linear(TURN), tables(top="histroy = 2")), "policy.toml: .*unknown field `histroy`"),
    "unknown key of one": (lambda f: write(f, linear(TURN), tables(each="sacle = 2.0")), "unknown field `sacle`.*observations"),
    "text for a number": (lambda f: write(f, linear(TURN), tables(each='scale = "2"')), "policy.toml: Expected .*scale"),
    "no outputs": (lambda f: write(f, linear(TURN), tables(outputs=(), top="outputs = []")), "policy.toml: has no outputs"),
    "no limits": (lambda f: write(f, linear(TURN), tables(limits="lower = 0.0")), "missing required field `upper`"),
    "limits": (lambda f: write(f, linear(TURN), tables(limits="lower = 1.0\nupper = 0.0")), "output 'v': lower is 1, must be below upper"),
    "infinite limit": (
        lambda f: write(f, linear(TURN), tables(limits="lower = 0.0\nupper = inf")),
        "output 'v': lower, upper or offset is",
    ),
    "scale 0": (lambda f: write(f, linear(TURN), tables(each="scale = 0.0")), "observation 'x': scale is 0.0, must be finite and not 0"),
    "scale nan": (lambda f: write(f, linear(TURN), tables(each="scale = nan")), "observation 'x': scale is nan"),
    "clip": (lambda f: write(f, linear(TURN), tables(each="clip = -1.0")), "observation 'x': clip is -1"),
    "twice": (lambda f: write(f, linear(TURN), tables(("x", "x"))), "observations name 'x' twice"),
    "history 0": (lambda f: write(f, linear(TURN), tables(top="history = 0")), "history is 0, must be from 1 to 32"),
    "history 33": (lambda f: write(f, linear(TURN), tables(top="history = 33")), "history is 33, must be from 1 to 32"),
}


@pytest.mark.parametrize("name", BAD_FILES)
def test_bad_file_is_one_line_before_anything_runs(name: str, tmp_path: Path) -> None:
    make, wanted = BAD_FILES[name]
    with pytest.raises(ConfigError, match=wanted) as caught:
        load(make(tmp_path))
    assert "\n" not in str(caught.value)


BAD_NETWORKS: dict[str, tuple[Callable[[Path], Path], str]] = {
    "observation": (
        lambda f: write(f, linear(TURN), tables(("x", "y", "speed"))),
        "observation 'speed' is not known; the robot's states: x, y",
    ),
    "output names": (lambda f: write(f, linear(TURN), tables(outputs=("w", "v"))), "its outputs are w, v; must be .* in order: v, w"),
    "offset": (lambda f: write(f, linear(TURN), tables(each="offset = [0.0, 1.0]")), "offset has 2 numbers, must be one, or 1"),
    "width": (lambda f: write(f, linear(np.ones((5, 2)))), r"policy.onnx: its input has shape \(n, 5\), must be \(n, 3\)"),
    "rank": (lambda f: write(f, linear(TURN, shape=[3])), r"its input has shape \(3\), must be \(n, 3\)"),
    "rows": (lambda f: write(f, linear(TURN, shape=["n", 1, 3])), r"its output has shape \(16, 1, 2\), must be \(16, 2\)"),
    "too few outputs": (lambda f: write(f, linear(TURN[:, :1])), r"its output has shape \(16, 1\), must be \(16, 2\)"),
    "whole numbers": (lambda f: write(f, linear(np.ones((3, 2)), kind=onnx.TensorProto.INT32)), r"z is a tensor\(int32\), must be one of"),
    "operator": (lambda f: write(f, linear(TURN, op="Telepathy")), "policy.onnx: onnxruntime cannot load it: .*Telepathy"),
    "custom operator": (lambda f: write(f, linear(TURN, op="Mind", domain="my.own")), "policy.onnx: onnxruntime cannot load it: .*my.own"),
}


@pytest.mark.parametrize("name", BAD_NETWORKS)
def test_network_that_does_not_fit_is_one_line_and_costs_no_attempt(name: str, tmp_path: Path) -> None:
    make, wanted = BAD_NETWORKS[name]
    with pytest.raises(ConfigError, match=wanted) as caught:
        s2r.verify(make(tmp_path), profile=GRID_PROFILE, radius=0.001)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_output_that_is_not_finite_is_refused_though_it_is_limited(value: float, tmp_path: Path) -> None:
    path = write(tmp_path, linear([[value, 0.0], [0.0, 0.0], [0.0, 0.0]]))
    with pytest.raises(Malformed, match=r"policy.onnx: the network's output for v is (nan|inf) .*must be finite"):
        answers(path, [[1.0, 0.0, 0.0]])
    found = s2r.verify(path, profile=GRID_PROFILE, radius=0.001)
    assert not found.passed
    assert "the network's output for v is" in found.verification.reason


def test_exit_codes_of_the_command_line(tmp_path: Path) -> None:
    def verify(path: Path, *options: str) -> tuple[int, str]:
        argv = [sys.executable, "-m", "s2r_runtime", "verify", str(path), "--profile", str(GRID_PROFILE), "--radius", "0.001", *options]
        done = subprocess.run(argv, capture_output=True, text=True, check=False, timeout=100)
        assert done.stderr.count("\n") <= 1
        return done.returncode, done.stderr + done.stdout

    assert verify(write(tmp_path, b"no"))[0] == 78
    assert verify(write(tmp_path, linear(np.ones((5, 2)))))[0] == 78
    code, text = verify(write(tmp_path, linear(TURN)), "--param", "gain=2")
    assert (code, "a learned policy has none" in text) == (2, True)
    assert verify(write(tmp_path, linear(np.full((3, 2), np.nan))))[0] == 1


def test_parameters_and_a_search_for_them_are_refused(tmp_path: Path) -> None:
    from s2r_runtime.controllers.candidates import declared_bounds

    path = write(tmp_path, linear(TURN))
    with pytest.raises(UsageError, match=r"has none; change policy\.toml"):
        s2r.verify(path, profile=GRID_PROFILE, radius=0.001, param={"gain": 2.0})
    with pytest.raises(ConfigError, match="no parameters to search"):
        declared_bounds(load(path), {"gain": (0.0, 1.0)})


def test_no_tube_is_read_off_a_network(tmp_path: Path) -> None:
    """Its bytes are no Python, and with a history it is no feedback of the state alone (guarantee G13)."""
    from s2r_runtime.controllers.linear_feedback import gain_of
    from s2r_runtime.controllers.observing import has_history

    assert gain_of(load(write(tmp_path, linear(TURN)))) is None
    assert [has_history(load(write(tmp_path, linear(TURN), tables(top=f"history = {h}")))) for h in (1, 2)] == [False, True]


def test_settings_of_another_version_are_refused(tmp_path: Path) -> None:
    file = msgspec.structs.replace(load(write(tmp_path, linear(TURN))), entry="onnx 0")
    assert policy.is_policy(file.entry)
    with pytest.raises(ConfigError, match="of version 'onnx 0', this runtime reads 'onnx 1'"):
        view_of(file, MODEL)


# ---------------------------------------------------------------- the example


def test_example_passes_on_the_grid(tmp_path: Path) -> None:
    found = s2r.verify(EXAMPLE / "grid_policy.onnx", profile=GRID_PROFILE, radius=0.001, law="uniform")
    assert found.passed, found.statement


@pytest.mark.slow
def test_the_examples_script_writes_a_policy_that_passes(tmp_path: Path) -> None:
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    for name in ("one", "two"):
        argv = [sys.executable, str(EXAMPLE / "train.py"), str(tmp_path / name)]
        subprocess.run(argv, check=True, env=environment, timeout=600, capture_output=True)
    one, two = ((tmp_path / name / "grid_policy.onnx").read_bytes() for name in ("one", "two"))
    assert one == two
    (tmp_path / "one" / "grid_policy.toml").write_text((EXAMPLE / "grid_policy.toml").read_text())
    assert s2r.verify(tmp_path / "one" / "grid_policy.onnx", profile=GRID_PROFILE, radius=0.001).passed
