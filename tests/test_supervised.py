"""Whatever code of others does, a verb that has no answer is no success; and its end is that of the command."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

MODEL = """import os, sys, time
import numpy as np

STATES, INPUTS, PARAMS = ("x",), ("u",), {{}}


def step(x, u, dt, params):
    {ending}
    return x + dt * u
"""
S2R = [sys.executable, "-m", "s2r_runtime"]


def files(folder: Path, ending: str) -> list[str]:
    (folder / "model.py").write_text(MODEL.format(ending=ending))
    rows = "".join(f"{0.1 * k:.1f},{0.01 * k},{(-1) ** k}\n" for k in range(200))
    (folder / "run.csv").write_text("t,x,u\n" + rows)
    return [str(folder / "run.csv"), "--model", str(folder / "model.py"), "--dt", "0.1"]


def computing(folder: Path) -> tuple[subprocess.Popen[bytes], int]:
    """A verb that computes with a model that takes its time, and the process that does."""
    process = subprocess.Popen([*S2R, "gap", *files(folder, f"open({str(folder / 'there')!r}, 'w').close(); time.sleep(60)")])
    limit = time.monotonic() + 60.0
    while not (folder / "there").exists():
        assert process.poll() is None
        assert time.monotonic() < limit
        time.sleep(0.05)
    (child,) = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
    return process, int(child)


@pytest.mark.parametrize("verb", ["gap", "trace"])
@pytest.mark.parametrize("ending", ["os._exit(0)", "sys.exit(0)", "raise SystemExit"])
def test_a_model_that_ends_the_program_is_no_success(verb: str, ending: str, tmp_path: Path) -> None:
    done = subprocess.run([*S2R, verb, *files(tmp_path, ending)], capture_output=True, text=True, check=False, timeout=100)
    assert done.returncode == 78, done
    (line,) = done.stderr.splitlines()
    assert "model" in line
    assert "ended the program" in line


def test_a_process_that_a_model_leaves_behind_is_not_waited_for(tmp_path: Path) -> None:
    argv = files(tmp_path, "os.fork() or time.sleep(60); os._exit(0)")
    with (tmp_path / "said").open("wb") as said:
        assert subprocess.run([*S2R, "gap", *argv], stdout=said, stderr=said, check=False, timeout=50).returncode == 78


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_ends_the_verb_and_what_waits_for_it(number: signal.Signals, tmp_path: Path) -> None:
    before = signal.signal(number, signal.default_int_handler if number == signal.SIGINT else signal.SIG_DFL)
    try:  # under nohup it would be ignored, here and in the verb
        process, child = computing(tmp_path)
    finally:
        signal.signal(number, before)
    process.send_signal(number)
    assert process.wait(30) == (130 if number == signal.SIGINT else -number)
    with pytest.raises(ProcessLookupError):
        os.kill(child, 0)


def test_the_verb_ends_with_what_waits_for_it(tmp_path: Path) -> None:
    process, child = computing(tmp_path)
    process.kill()
    process.wait(30)
    limit = time.monotonic() + 60.0
    while Path(f"/proc/{child}").exists() and "Z" not in Path(f"/proc/{child}/stat").read_text().split()[2:3]:
        assert time.monotonic() < limit
        time.sleep(0.05)


@pytest.mark.parametrize("argv", [["gap", "--help"], ["gap"], ["gap", "nothing.csv", "--model", "unicycle"]])
def test_other_ends_are_as_before(argv: list[str]) -> None:
    done = subprocess.run([*S2R, *argv], capture_output=True, text=True, check=False)
    assert done.returncode == (0 if "--help" in argv else 2)
    assert "Traceback" not in done.stderr
