"""A controller under verification says what it would do, and nothing about how it did: no attempt of its own at the verdict changes it."""

from __future__ import annotations

import contextlib
import os
import platform
import textwrap
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from worker_rig import finished, verify_job

from s2r_runtime.controllers.batches import BatchController
from s2r_runtime.controllers.code import Malformed, Raised, batch_control
from s2r_runtime.controllers.file import load
from s2r_runtime.daemon.worker import Failed, Result
from s2r_runtime.errors import ControllerError

pytestmark = pytest.mark.skipif(platform.machine() not in {"x86_64", "aarch64"}, reason="system calls are filtered on these processors")

HOLD = "return x[:, :2] * 0"
DRIVE_INTO_THE_WALL = "return np.tile([0.2, 0.0], (len(x), 1))"
FORGED = (
    '{"type":"result","verification":{"passed":true,"radius":0.02,"hold_radius":0.02,"threshold":0.0,"epsilon":0.3,"beta":0.1,'
    '"attempt":1,"seed":1,"laws":[],"controller_digest":"","model_digest":"","task_digest":""}}\\n'
)


@contextlib.contextmanager
def running(folder: Path, body: str, head: str = "") -> Iterator[BatchController]:
    with BatchController(load(write(folder, body, head)), 2, 1 << 30) as control:
        yield control


def write(folder: Path, body: str, head: str = "") -> Path:
    path = folder / "controller.py"
    path.write_text(f"import os\nimport numpy as np\n{head}\ndef control(x, theta, parameters):\n{textwrap.indent(body, '    ')}\n")
    return path


def test_batches_are_answered_as_in_this_process_bit_for_bit(tmp_path: Path) -> None:
    path = write(tmp_path, "return np.tanh(x[:, :2] * theta['gain'][:, None] + theta['flag'][:, :2] + len(theta['name']))")
    here, rng = batch_control(load(path), 2), np.random.default_rng(1)
    with running(tmp_path, path.read_text().partition("parameters):\n    ")[2].strip()) as there:
        for n, order in ((1, "C"), (7, "F"), (5000, "F"), (3, "C")):
            x = np.array(rng.normal(size=(n, 3)), order=order)  # type: ignore[call-overload]
            theta = {"gain": rng.normal(size=(n, 2))[:, 0], "flag": rng.random((n, 3, 2))[:, :, 0] > 0.5, "name": "text"}
            np.testing.assert_array_equal(there(x, theta), here(x, theta))


def test_what_it_raises_in_one_state_keeps_it_from_no_other(tmp_path: Path) -> None:
    with running(tmp_path, "if x[0, 0] > 1: raise ValueError('too far')\nif x[0, 0] < 0: return x\n" + HOLD) as control:
        with pytest.raises(Raised, match=r"ValueError: too far \(controller\.py line 5\)"):
            control(np.full((2, 3), 2.0), {})
        with pytest.raises(Malformed, match=r"shape \(2, 3\)"):
            control(np.full((2, 3), -1.0), {})
        np.testing.assert_array_equal(control(np.zeros((2, 3)), {}), np.zeros((2, 2)))


@pytest.mark.slow
@pytest.mark.parametrize("wait", ["pass", "time.sleep(1.0); os.write(3, b'x')"], ids=["silent", "byte by byte"])
def test_one_that_never_answers_ends_where_nobody_else_watches_it(tmp_path: Path, wait: str) -> None:
    head = f"import time\ndef wait():\n    os.write(3, b'u' + (16).to_bytes(8, 'little'))\n    while True: {wait}"
    path = write(tmp_path, f"{HOLD} if not x.any() else wait()", head)
    with BatchController(load(path), 2, within_s=20.0) as control:
        np.testing.assert_array_equal(control(np.zeros((1, 3)), {}), np.zeros((1, 2)))
        control._within_s = 2.0
        with pytest.raises(ControllerError, match="no answer within 2 s"):
            control(np.ones((1, 3)), {})
        assert control.pid == 0


@pytest.mark.parametrize(
    ("body", "words"),
    [
        ("os._exit(7)", r"died in the middle of a question \(exited with status 7\)"),
        ("import ctypes; ctypes.string_at(0)", r"killed by SIGSEGV"),
        ("os.closerange(3, 60); return x[:, :2]", "died in the middle of a question"),
        ("put(b'u' + (1 << 60).to_bytes(8, 'little')); " + HOLD, "announced 1152921504606846976 bytes, at most 64"),
        ("put(b'u' + (8).to_bytes(8, 'little') + b'x' * 8); " + HOLD, "answered 8 bytes, must be 64"),
        ("put(b'u' + (64).to_bytes(8, 'little') + b'\\xff' * 64); " + HOLD, "not finite"),
        ("put(b'?' + (2).to_bytes(8, 'little') + b'hi'); " + HOLD, "hi"),
    ],
    ids=["exits", "crashes", "hangs up", "announces an exabyte", "too few", "NaN past the check", "another kind"],
)
def test_whatever_its_process_sends_is_an_answer_or_the_end(tmp_path: Path, body: str, words: str) -> None:
    head = """
def put(data):
    for f in range(3, 60):
        try:
            os.write(f, data)
        except OSError:
            pass
"""
    with running(tmp_path, body, head) as control, pytest.raises(ControllerError, match=words):
        control(np.zeros((4, 3)), {})
    assert control._pid == 0


def test_once_gone_it_stays_gone_and_nobody_else_is_killed_for_it(tmp_path: Path) -> None:
    with running(tmp_path, "os._exit(0)") as control:
        for _ in range(3):
            with pytest.raises(ControllerError, match="died in the middle"):
                control(np.zeros((1, 3)), {})
    control.close()


@pytest.mark.slow
@pytest.mark.parametrize(
    "attack",
    [
        f"for f in range(3, 60):\n    try: os.write(f, b'''{FORGED}''')\n    except OSError: pass",
        "import sys\nfor m in list(sys.modules.values()):\n    if hasattr(m, '_judge'): m._judge = m._why_not = lambda *a: ''",
        "import gc\nfor o in gc.get_objects():\n    if isinstance(o, np.ndarray) and o.dtype == float and o.flags.writeable: o[...] = 1e9",
        "np.min = np.nanmin = np.quantile = lambda *a, **k: 1e9\nnp.sum = lambda *a, **k: 0",
        "theta.clear(); [v.fill(0) for v in theta.values()]",
    ],
    ids=["writes the result", "changes the judge", "changes what was computed", "changes numpy", "changes the scenario"],
)
def test_a_bad_controller_cannot_pass_by_other_means_than_driving_well(tmp_path: Path, attack: str) -> None:
    path = write(tmp_path, f"try:\n{textwrap.indent(attack, '    ')}\nexcept Exception:\n    pass\n{DRIVE_INTO_THE_WALL}")
    honest = write(tmp_path / "honest", DRIVE_INTO_THE_WALL) if (tmp_path / "honest").mkdir() is None else path
    said, plain = finished(verify_job(path))[-1], finished(verify_job(honest))[-1]
    assert isinstance(plain, Result)
    assert plain.verification is not None
    assert not plain.verification.passed
    if isinstance(said, Failed):
        return
    assert isinstance(said, Result)
    assert said.verification is not None
    assert not said.verification.passed
    if "controller.py" not in said.verification.reason:  # it drove to the end: then as it would have without
        assert said.verification.laws[0].s_star == pytest.approx(plain.verification.laws[0].s_star, abs=0.2)


def test_the_process_has_nothing_of_its_parents(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("S2R_SECRET", "1")
    body = """
found = [f for f in range(60) if os.path.exists(f'/proc/self/fd/{f}')]
import ctypes
raw = ctypes.c_void_p.in_dll(ctypes.CDLL(None), 'environ').value
raise ValueError(f'{len(found)} {os.getcwd()} {dict(os.environ)} {raw} {os.getsid(0) == os.getpid()}')
"""
    secret = os.open(write(tmp_path, HOLD), os.O_RDONLY)
    os.set_inheritable(secret, True)
    try:
        with running(tmp_path, body) as control, pytest.raises(Raised, match=r"ValueError: 5 / \{'PATH': [^}]*\} \d+ False"):
            control(np.zeros((1, 3)), {})
    finally:
        os.close(secret)
