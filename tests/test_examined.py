"""A controller can't tell from where it runs whether it is verified, rehearsed or drives: all that it can see of that is the same."""

from __future__ import annotations

import re
import textwrap
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from controllers_rig import MODEL, Hosted
from worker_rig import finished, verify_job

from s2r_runtime.controllers.batches import BatchController
from s2r_runtime.controllers.code import Raised
from s2r_runtime.controllers.file import load
from s2r_runtime.controllers.hosted import Reply, Stopped
from s2r_runtime.daemon.worker import Result
from s2r_runtime.models.composed import compose
from s2r_runtime.plugins import registry
from s2r_runtime.profile import TaskChoice

FACETS = {
    "command line": "sys.argv, sys.orig_argv, sys.executable, sys.flags, sys.path",
    "modules": "sorted(name for name in sys.modules if not name.startswith('controller_'))",
    "environment": "sorted(os.environ.items())",
    "folder": "os.getcwd()",
    "descriptors": "[(f, stat.S_IFMT(os.fstat(f).st_mode), os.get_inheritable(f)) for f in range(64) if is_open(f)]",
    "identity": "os.getuid(), os.getgid(), os.getgroups(), os.getsid(0) == os.getpid(), os.getpgid(0) == os.getpid()",
    "limits": "[resource.getrlimit(getattr(resource, name)) for name in sorted(dir(resource)) if name.startswith('RLIMIT_')]",
    "status": "[line for line in open('/proc/self/status') if line.split(':')[0] in STATUS]",
    "priority": "len(os.sched_getaffinity(0)), [refused(*a) for a in ((os.getpriority, 0, 0), (os.sched_getscheduler, 0), (open, STAT))]",
    "collector": "gc.isenabled(), gc.get_threshold(), gc.callbacks",
    "signals": "[(s, str(signal.getsignal(s))) for s in signal.valid_signals()], signal.pthread_sigmask(signal.SIG_BLOCK, [])",
    "callers": "callers()",
    "limits of calls": "sys.getrecursionlimit(), sys.getswitchinterval(), sys.gettrace(), sys.getprofile(), threading.active_count()",
    "call": "CALLS",
    "numpy": "sorted(np.geterr().items()), np.get_printoptions()['precision']",
    "arguments": "described(x), sorted((k, described(v)) for k, v in theta.items()), sorted(parameters)",
}
PROBE = """
import gc, os, resource, signal, stat, sys, threading, zlib
import numpy as np

PARAMETERS = {"gain": 1.0}
STATUS = ("Umask", "Threads", "Seccomp", "NoNewPrivs", "CapEff", "CapBnd", "SigIgn", "SigCgt", "TracerPid")
CALLS = 0
STAT = "/proc/self/stat"

def is_open(f):
    try:
        os.fstat(f)
    except OSError:
        return False
    return True

def refused(call, *arguments):
    try:
        return call(*arguments)
    except PermissionError as error:
        return str(error)

def callers():
    frame, found = sys._getframe(1), []
    while frame:
        found.append((frame.f_code.co_filename, frame.f_code.co_name, frame.f_lineno, sorted(frame.f_locals)))
        frame = frame.f_back
    return found[3:]

def described(v):
    if not isinstance(v, np.ndarray):
        return type(v).__name__, v
    own = v.base is None, type(v.base).__name__
    return v.shape, v.dtype.str, v.strides, str(v.flags), own

def control(x, theta, parameters):
    global CALLS
    CALLS += 1
    facets = []
    for text in FACETS:
        facets.append("%08x" % zlib.crc32(repr(eval(text, {**globals(), **locals()})).encode()))
    raise ValueError(" ".join(facets))
"""


def probe(folder: Path) -> Path:
    path = folder / "controller.py"
    path.write_text(PROBE + f"\nFACETS = {list(FACETS.values())!r}\n", encoding="utf-8")
    return path


def told(text: str) -> dict[str, str]:
    found = re.search(r"ValueError: ((?:[0-9a-f]{8} ?)+)", text)
    assert found, text
    return dict(zip(FACETS, found[1].split(), strict=True))


def driven(path: Path) -> dict[str, str]:
    it = Hosted(load(path), TaskChoice("grid_world"), memory_bytes=0)
    try:
        it.next()
        stopped = it.ask((0.2, 0.2, 0.0))
        assert isinstance(stopped, Stopped)
        return told(stopped.detail)
    finally:
        it.host.close()


def rehearsed(path: Path, rows: int) -> dict[str, str]:
    """rows: of the scenarios that the asked one is cut out of, as a rehearsal does."""
    model = compose(MODEL)
    task = registry().get("tasks", "grid_world")({}, model.nominal, MODEL.dt)
    scenario = task.draw(np.random.default_rng(1), rows)
    view, one = task.view(scenario), slice(rows - 1, rows)
    theta = {name: value[one] if isinstance(value, np.ndarray) and len(value) == rows else value for name, value in view.items()}
    with BatchController(load(path), 2) as control, pytest.raises(Raised) as caught:
        control(np.asfortranarray(scenario["start"])[one], theta)
    return told(str(caught.value))


def verified(path: Path) -> dict[str, str]:
    said = finished(verify_job(path))[-1]
    assert isinstance(said, Result), said
    assert said.verification is not None
    return told(said.verification.reason)


@pytest.mark.slow
def test_driving_and_rehearsal_look_the_same_in_every_respect(tmp_path: Path) -> None:
    path = probe(tmp_path)
    drives = driven(path)
    assert rehearsed(path, 1) == rehearsed(path, 4) == drives


@pytest.mark.slow
def test_verification_differs_from_driving_in_the_number_of_rows_alone(tmp_path: Path) -> None:
    path = probe(tmp_path)
    verification, drives = verified(path), driven(path)
    assert {name for name in FACETS if verification[name] != drives[name]} == {"arguments"}


def test_the_probe_sees_what_differs(tmp_path: Path) -> None:
    """It would have told the processes of before apart."""
    path = probe(tmp_path)
    one = rehearsed(path, 1)
    path.write_text(
        path.read_text(encoding="utf-8") + "\nimport wave\nos.dup(0)\nsys.argv.append('x')\nos.environ['X'] = '1'\n", encoding="utf-8"
    )
    other = rehearsed(path, 1)
    assert {name for name in FACETS if one[name] != other[name]} == {"modules", "descriptors", "command line", "environment"}


CLUES = {
    "modules": "any('hosting' in name or 'worker' in name or 'verify' in name for name in sys.modules)",
    "command line": "'hosting' in ' '.join(sys.orig_argv) or 'worker' in ' '.join(sys.orig_argv)",
    "objects": "any(type(o).__name__ in ('Episodes', 'HostedController', 'VerifyJob', 'Kept') for o in gc.get_objects())",
    "callers": "sys._getframe(2).f_code.co_name in ('_host', '_answer', 'roll_out')",
    "folder": "os.getcwd() != '/'",
}


@pytest.mark.parametrize("clue", CLUES)
def test_a_controller_with_two_faces_shows_one(tmp_path: Path, clue: str) -> None:
    body = f"""
        import gc, os, sys
        import numpy as np
        def control(x, theta, parameters):
            return np.tile([0.2, 0.0] if {CLUES[clue]} else [0.0, 0.1], (len(x), 1))
    """
    path = tmp_path / "controller.py"
    path.write_text(textwrap.dedent(body), encoding="utf-8")
    it = Hosted(load(path))
    try:
        it.next()
        reply = it.ask()
        assert isinstance(reply, Reply)
    finally:
        it.host.close()
    ask: Callable[[BatchController], np.ndarray] = lambda control: control(np.array([[0.5, 0.25, 0.0]]), {})  # noqa: E731
    with BatchController(load(path), 2) as control:
        assert tuple(ask(control)[0]) == reply.u == (0.0, 0.1)
