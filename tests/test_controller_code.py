"""Controllers executed in this process: exactly the digested bytes, on views they can't change, with checked answers."""

from __future__ import annotations

import textwrap
from pathlib import Path

import msgspec
import numpy as np
import pytest

from s2r_runtime.controllers.code import Malformed, Raised, batch_control
from s2r_runtime.controllers.file import ControllerFile, load
from s2r_runtime.errors import ControllerError

GOOD = """
import numpy as np
PARAMETERS = {"gain": 1.5, "steps": 3}
def control(x, theta, parameters):
    return np.stack([parameters["gain"] * x[:, 0], x[:, 1]], axis=1)
"""


def write(folder: Path, source: str, name: str = "controller.py") -> Path:
    path = folder / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(textwrap.dedent(source))
    return path


def loaded(folder: Path, body: str, head: str = "") -> ControllerFile:
    """A controller whose `control` has this body."""
    function = "def control(x, theta, parameters):\n" + textwrap.indent(textwrap.dedent(body).strip(), "    ")
    return load(write(folder, f"import numpy as np\n{textwrap.dedent(head)}\n{function}\n"))


def test_a_batch_runs_on_the_given_parameters(tmp_path: Path) -> None:
    control = batch_control(load(write(tmp_path, GOOD), {"gain": 2.0}), 2)
    x = np.array([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]])
    np.testing.assert_array_equal(control(x, {}), [[2.0, 2.0], [8.0, 5.0]])


def test_what_runs_is_what_was_digested_whatever_happens_to_the_files(tmp_path: Path) -> None:
    write(
        tmp_path,
        "import lazily_changed as m\ndef control(x, theta, parameters):\n    import late_changed\n    return m.f(x) + late_changed.ONE",
    )
    write(tmp_path, "def f(x): return 0 * x[:, :2]", "lazily_changed.py")
    write(tmp_path, "ONE = 1", "late_changed.py")
    file = load(tmp_path / "controller.py")
    for name in ("controller.py", "lazily_changed.py", "late_changed.py"):
        write(tmp_path, "raise RuntimeError('changed')", name)
    np.testing.assert_array_equal(batch_control(file)(np.zeros((2, 3)), {}), np.ones((2, 2)))


def test_two_controllers_with_different_modules_of_one_name_do_not_mix(tmp_path: Path) -> None:
    sources = "import sharedname\ndef control(x, theta, parameters): return x[:, :2] * sharedname.K"
    for folder, k in (("a", 1), ("b", 2)):
        write(tmp_path / folder, sources)
        write(tmp_path / folder, f"K = {k}", "sharedname.py")
    batch_control(load(tmp_path / "a" / "controller.py"))
    with pytest.raises(ControllerError, match="another controller in this process has a different one"):
        batch_control(load(tmp_path / "b" / "controller.py"))


def test_a_library_that_changed_since_the_digest_is_refused(tmp_path: Path) -> None:
    file = load(write(tmp_path, GOOD))
    with pytest.raises(ControllerError, match=r"digested with numpy 0\.1, here is"):
        batch_control(msgspec.structs.replace(file, libraries={"numpy": "0.1"}))
    with pytest.raises(ControllerError, match=r"digested under CPython 2\.7"):
        batch_control(msgspec.structs.replace(file, python="CPython 2.7"))


BAD_ANSWERS = [
    ("return np.full((len(x), 2), np.nan)", "returned nan"),
    ("return np.full((len(x), 2), -np.inf)", "returned -inf"),
    ("return np.zeros((len(x), 3))", r"returned shape \(\d, 3\)"),
    ("return np.zeros(2)", r"returned shape \(2,\)"),
    ("return np.zeros((len(x) + 1, 2))", "returned shape"),
    ("return None", "returned NoneType"),
    ("return 'left'", "returned str"),
    ("return [[1.0, 2.0], [3.0]]", "returned list"),
    ("return np.zeros((len(x), 2), dtype=complex)", "complex128"),
    ("return np.zeros((len(x), 2), dtype=bool)", "bool"),
    ("return np.array([[object(), 1]] * len(x))", "object"),
]


@pytest.mark.parametrize(("body", "message"), BAD_ANSWERS)
def test_a_batch_that_is_no_finite_input_is_malformed(tmp_path: Path, body: str, message: str) -> None:
    control = batch_control(loaded(tmp_path, body), 2)
    with pytest.raises(Malformed, match=message):
        control(np.zeros((3, 3)), {})


def test_a_controller_cannot_change_the_scenario_it_is_verified_on(tmp_path: Path) -> None:
    theta = {"obstacles": np.ones((1, 4)), "name": "a"}
    for body in ("theta['obstacles'][:] = 9; return x[:, :2]", "x[:] = 9; return x[:, :2]"):
        x = np.zeros((1, 3))
        with pytest.raises(Raised, match="read-only"):
            batch_control(loaded(tmp_path, body))(x, theta)
        assert not x.any()
    batch_control(loaded(tmp_path, "theta.clear(); parameters.clear(); return x[:, :2]"))(np.zeros((1, 3)), theta)
    assert list(theta) == ["obstacles", "name"]
    np.testing.assert_array_equal(theta["obstacles"], np.ones((1, 4)))


def test_what_a_batch_raises_is_told_with_its_line(tmp_path: Path) -> None:
    with pytest.raises(Raised, match=r"controller\.py: ZeroDivisionError: division by zero \(controller\.py line 4\)"):
        batch_control(loaded(tmp_path, "return 1 / 0"))(np.zeros((1, 3)), {})
    with pytest.raises(Raised, match=r"SystemExit: 0"):
        batch_control(loaded(tmp_path, "import sys; sys.exit(0)"))(np.zeros((1, 3)), {})
    with pytest.raises(Raised, match=r"RuntimeError: early"):
        batch_control(load(write(tmp_path, "def control(x, theta, parameters): return x\nraise RuntimeError('early')")))
