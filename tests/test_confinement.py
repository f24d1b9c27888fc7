"""A confined process: what it can no longer do, and what goes on."""

from __future__ import annotations

import fcntl
import os
import platform
import re
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest
from confinement_rig import LANDLOCK

from s2r_runtime.controllers import confinement
from s2r_runtime.controllers.confined_process import remove_left_folders

pytestmark = pytest.mark.skipif(platform.machine() not in {"x86_64", "aarch64"}, reason="system calls are filtered on these processors")


IPC = {
    "msgget": (68, 186), "msgsnd": (69, 189), "msgrcv": (70, 188), "msgctl": (71, 187), "semget": (64, 190), "semctl": (66, 191),
    "semop": (65, 193), "semtimedop": (220, 192), "shmget": (29, 194), "shmat": (30, 196), "shmctl": (31, 195), "mq_open": (240, 180),
    "mq_unlink": (241, 181), "mq_timedsend": (242, 182), "mq_timedreceive": (243, 183), "mq_notify": (244, 184), "inotify_init1": (294, 26),
    "inotify_add_watch": (254, 27), "fanotify_init": (300, 262), "capset": (126, 91), "setuid": (105, 146), "sync": (162, 81),
}  # fmt: skip
"""Calls of System V and POSIX between processes, and others that a list of what is denied would have to know: (x86-64, 64-bit ARM)."""

CONFINED = """
import os, sys
exec(sys.argv[3])
from s2r_runtime.controllers.confinement import confine
import ctypes, platform
PATH, ARM = sys.argv[1], platform.machine() == "aarch64"
def call(*arguments):
    if ctypes.CDLL(None, use_errno=True).syscall(*arguments) < 0:
        raise OSError(ctypes.get_errno(), "system call")
in_force = confine(1 << 28)
try:
    exec(sys.argv[2])
except (OSError, ValueError) as error:
    print("refused", error)
else:
    print("done", *in_force)
"""


def confined(code: str, path: Path, before: str = "") -> str:
    """What a process prints that confines itself and then runs the code."""
    command = [sys.executable, "-c", CONFINED, str(path), code, before]
    return subprocess.run(command, capture_output=True, text=True, check=True, cwd=path.parent, timeout=60).stdout


@pytest.fixture
def target(tmp_path: Path) -> Path:
    """A file that stays as it is."""
    (tmp_path / "target.txt").write_text("kept")
    return tmp_path / "target.txt"


@pytest.mark.slow
@pytest.mark.parametrize(
    "code",
    [
        "import os; os.fork()",
        *(f"call({x86} if not ARM else {arm}, 0, 0, 0, 0)" for x86, arm in IPC.values()),
        "import subprocess; subprocess.run(['/bin/true'])",
        "import os; os.execv('/bin/true', ['true'])",
        "import os; os.posix_spawn('/bin/true', ['true'], {})",
        "import multiprocessing; multiprocessing.Process(target=print).start()",
        "import socket; socket.socket()",
        "import socket; socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)",
        "import urllib.request; urllib.request.urlopen('http://127.0.0.1:1')",
        "import os; os.kill(os.getppid(), 9)",
        "import os; os.killpg(0, 9)",
        "open('new', 'w')",
        "open('/proc/self/mem', 'r+b')",
        "open(f'/proc/{__import__(\"os\").getppid()}/mem', 'r+b')",
        "import os; os.unlink(PATH)",
        "import os; os.rename(PATH, PATH + 'x')",
        "import os; os.truncate(PATH, 0)",
        "import os; os.chmod(PATH, 0o777)",
        "import os; os.mkdir(PATH + 'd')",
        "import os; os.symlink(PATH, PATH + 'l')",
        "import os; os.utime(PATH)",
        "import os; os.setxattr(PATH, 'user.a', b'b')",
        "import resource; resource.setrlimit(resource.RLIMIT_AS, (-1, -1))",
        "import resource; resource.prlimit(0, resource.RLIMIT_AS, (-1, -1))",
        "import os; os.setpriority(os.PRIO_PROCESS, 0, -5)",
        "import os; os.sched_setaffinity(0, {0})",
        "import os; os.setsid()",
        "import time; time.clock_settime(time.CLOCK_REALTIME, 0)",
        "import os; os.pidfd_open(os.getppid())",
        "import socket; socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)[0].sendto(b'READY=1', PATH)",
        "import fcntl, os; fcntl.fcntl(os.pipe()[0], 8, os.getppid())",  # F_SETOWN: whom data in the pipe will signal
        "import fcntl, os; fcntl.fcntl(os.pipe()[0], 10, 9)",  # F_SETSIG: with what
        "import fcntl, os; fcntl.fcntl(os.pipe()[0], 15, bytes(8))",  # F_SETOWN_EX
        "import fcntl, os; fcntl.ioctl(os.pipe()[0], 0x5452, bytes(4))",  # FIOASYNC
        "import fcntl, os; fcntl.fcntl(os.open(os.__file__, os.O_RDONLY), fcntl.F_SETLEASE, fcntl.F_RDLCK)",
        "import fcntl, os; fcntl.fcntl(os.open(os.path.dirname(os.__file__), os.O_RDONLY), fcntl.F_NOTIFY, fcntl.DN_MODIFY)",
        "import fcntl, os; fcntl.flock(os.open(os.__file__, os.O_RDONLY), fcntl.LOCK_SH)",
        "import fcntl, os; fcntl.lockf(os.open(os.__file__, os.O_RDONLY), fcntl.LOCK_SH)",
        "call(30 if ARM else 251, 1, os.getppid(), 0)",  # ioprio_set
        "call(463, 0, 0, 0, 0, 0, 0)",  # setxattrat: newer than the list
        "call(511, 0)",  # a system call that is yet to be invented
    ],
)
def test_what_reaches_out_of_the_process_is_refused(target: Path, code: str) -> None:
    assert confined(code, target).startswith("refused")
    assert [path.name for path in target.parent.iterdir()] == ["target.txt"]
    assert target.read_text() == "kept"


@pytest.mark.parametrize(
    "code",
    [
        "import threading; t = threading.Thread(target=print); t.start(); t.join()",
        "import concurrent.futures as c; list(c.ThreadPoolExecutor(4).map(sum, [[1]] * 99))",
        "import numpy as np; print(np.linalg.svd(np.random.default_rng(1).normal(size=(300, 300)))[1][0])",
        "import numpy as np; print(np.fft.fft(np.ones(4096)).sum(), np.linalg.eigvals(np.eye(80)).sum())",
        "import scipy.linalg, scipy.optimize as o; print(o.minimize(lambda x: x @ x, [1.0, 2.0]).x)",
        "os.environ['OPENBLAS_NUM_THREADS'] = '4'; import numpy as np; a = np.ones((700, 700)); print((a @ a)[0, 0])",
        "import random, secrets, uuid, datetime, decimal, tempfile; secrets.token_hex(8); uuid.uuid4()",
        "import asyncio; asyncio.Queue()",
        "import json.tool, sqlite3, zoneinfo; zoneinfo.ZoneInfo('UTC')",
        "import fcntl, os; fcntl.fcntl(os.pipe()[0], fcntl.F_GETFL)",
        "import numpy as np; np.linalg.solve(np.eye(50), np.ones(50))",
        "import resource; resource.getrlimit(resource.RLIMIT_AS)",
        "import time; time.sleep(0.001)",
        "bytearray(1 << 27)",
    ],
)
def test_computing_reading_and_threads_go_on(target: Path, code: str) -> None:
    assert confined(code, target).splitlines()[-1] == f"done memory files privileges {'reading ' if LANDLOCK else ''}system_calls"


@pytest.mark.skipif(not LANDLOCK, reason="this kernel has no Landlock")
@pytest.mark.parametrize(
    "code",
    [
        "open(PATH).read()",
        "os.listdir(os.path.dirname(PATH))",
        "os.listdir('.')",
        "os.chdir('/proc/self/root'); open('etc/passwd').read()",
        "open('/proc/self/environ').read()",
        "open('/proc/%d/environ' % os.getppid()).read()",
        "ctypes.CDLL(PATH)",
        "import mmap; mmap.mmap(os.open(PATH, os.O_RDONLY), 0, prot=mmap.PROT_READ)",
    ],
)
def test_what_is_no_code_cannot_be_read(target: Path, code: str) -> None:
    assert "ermission denied" in confined(code, target)


@pytest.mark.skipif(not LANDLOCK, reason="this kernel has no Landlock")
def test_a_package_that_is_a_link_in_its_folder_can_go_on_importing_itself(target: Path, tmp_path_factory: pytest.TempPathFactory) -> None:
    real, site = tmp_path_factory.mktemp("real") / "linked", tmp_path_factory.mktemp("site")
    real.mkdir()
    for name in ("__init__.py", "late.py"):
        (real / name).write_text("")
    (real.parent / "secret.txt").write_text("kept")
    (site / "linked").symlink_to(real)
    before = f"sys.path.append({str(site)!r}); import linked"
    assert confined("import linked.late", target, before).startswith("done")
    assert "ermission denied" in confined(f"open({str(real.parent / 'secret.txt')!r})", target, before)


def test_reading_stays_free_where_the_kernel_cannot_contain_it_and_that_is_said(target: Path) -> None:
    code = "print(open(PATH).read())"
    said = confined(code, target, before="from s2r_runtime.controllers import reading; reading.restrict = lambda places: False")
    assert said == "kept\ndone memory files privileges system_calls\n"


def test_memory_beyond_the_limit_is_refused(target: Path) -> None:
    code = "try:\n    bytearray(1 << 29)\nexcept MemoryError:\n    raise OSError('no memory')"
    assert confined(code, target) == "refused no memory\n"


def test_a_second_confinement_lifts_nothing(target: Path) -> None:
    assert confined("confine(1 << 40)", target).startswith("refused")


def test_the_filters_program_fits_both_processors() -> None:
    for machine in ("x86_64", "aarch64"):
        program = confinement._filter(machine)
        assert program is not None
        assert len(program) % 8 == 0
        assert len(program) // 8 < 4096  # BPF_MAXINSNS
    assert confinement._filter("riscv64") is None


def test_the_numbers_of_the_system_calls_are_the_kernels() -> None:
    """Where the kernel's headers are installed."""
    columns = (("/usr/include/x86_64-linux-gnu/asm/unistd_64.h", "__NR_"), ("/usr/include/asm-generic/unistd.h", "__NR3264_"))
    for column, (header, other_prefix) in enumerate(columns):
        if not Path(header).exists():
            continue
        words = [line.split() for line in Path(header).read_text().splitlines() if line.startswith("#define __NR")]
        known = {w[1].removeprefix(other_prefix).removeprefix("__NR_"): int(w[2]) for w in words if len(w) > 2 and w[2].isdigit()}
        for name, numbers in {**confinement._ALLOWED, **confinement._UNKNOWN}.items():
            if name in known:
                assert numbers[column] == known[name], name


@pytest.mark.skipif(os.geteuid() != 0, reason="only root has capabilities to lose")
def test_roots_capabilities_are_gone(target: Path) -> None:
    target.chmod(0)
    code = "print([l for l in open('/proc/self/status') if l.startswith('Cap')])"
    said = confined(code, target, before="from s2r_runtime.controllers import reading; reading.restrict = lambda places: False")
    held = dict(re.findall(r"(Cap\w+):\\t(\w+)", said))
    assert {name: int(bits, 16) for name, bits in held.items() if name != "CapBnd"} == {"CapInh": 0, "CapPrm": 0, "CapEff": 0, "CapAmb": 0}


def test_a_folder_that_a_killed_daemon_left_is_removed_at_the_next_start(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    left, held, young = (tmp_path / f"s2r-controller-{name}" for name in ("left", "held", "young"))
    for folder in (left, held, young):
        folder.mkdir()
    for folder in (left, held):
        os.utime(folder, (0, 0))
    holding = os.open(held, os.O_RDONLY)
    fcntl.flock(holding, fcntl.LOCK_EX)
    remove_left_folders()
    os.close(holding)
    assert not left.exists()
    assert held.exists()
    assert young.exists()
