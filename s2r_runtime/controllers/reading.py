"""What a confined process may still read: code, and what libraries look up. Everything else is as if it were not permitted (Landlock).

A controller that reads a file at run time depends on something that its digest does not cover, and one that reads a private key knows
what it should not: so it may open the interpreter's and the libraries' folders, the shared objects of the system, time zones, random
numbers, and what the kernel tells about processors and about its own memory. It can't open its own file either: it runs from memory.

The mechanism is Landlock (landlock(7); Linux 5.13 and newer, where it is switched on), which needs no privileges and cannot be lifted.
Where there is none, `restrict` says so and reading is not contained. Beyond reading it denies once more what seccomp denies already:
writing, TCP (from 6.7), signals and abstract sockets of others (from 6.12).
"""

from __future__ import annotations

import ctypes
import os
import struct
import sys
from collections.abc import Iterable, Iterator
from pathlib import Path

_CREATE, _ADD, _RESTRICT = 444, 445, 446  # system calls; the same numbers on x86-64 and 64-bit ARM
_ABI_OF, _PATH_BENEATH = 1, 1  # LANDLOCK_CREATE_RULESET_VERSION, LANDLOCK_RULE_PATH_BENEATH
_READ_FILE, _READ_DIR = 1 << 2, 1 << 3
_FILE_RIGHTS = {1: 13, 2: 14, 3: 15, 4: 15, 5: 16}
"""LANDLOCK_ACCESS_FS_*: how many there are, by version of the interface (5 and later: 16)."""
_TCP, _SCOPES = 0b11, 0b11  # bind and connect (from version 4); abstract sockets and signals (from 6)

SYSTEM = (
    "/lib", "/lib32", "/lib64", "/usr/lib", "/usr/lib64", "/usr/local/lib", "/etc/ld.so.cache",
    "/usr/share/zoneinfo", "/etc/localtime", "/dev/null", "/dev/zero", "/dev/urandom", "/dev/random",
    "/proc/cpuinfo", "/proc/meminfo", "/proc/stat", "/proc/sys/vm/overcommit_memory", "/sys/devices/system/cpu", "/sys/fs/cgroup",
    "/proc/self/maps", "/proc/self/statm", "/proc/self/status", "/proc/self/cgroup",
)  # fmt: skip
"""What libraries look at besides code: how many processors and how much memory there are, where their own memory is, what time it is."""


def restrict(places: Iterable[Path]) -> bool:
    """From here on only what lies at these places can be read, in every thread and for good. False: this kernel has no Landlock.

    The process must have no_new_privs. Raises OSError if the kernel has it and refuses all the same.
    """
    libc = ctypes.CDLL(None, use_errno=True)
    abi = libc.syscall(_CREATE, None, ctypes.c_size_t(0), _ABI_OF)
    if abi < 1:
        return False
    handled = (1 << _FILE_RIGHTS.get(abi, 16)) - 1
    net, scopes = (_TCP if abi >= 4 else 0), (_SCOPES if abi >= 6 else 0)
    attribute = struct.pack("=QQQ", handled, net, scopes)[: 8 if abi < 4 else 16 if abi < 6 else 24]
    ruleset = _call(libc, _CREATE, attribute, ctypes.c_size_t(len(attribute)), 0)
    try:
        for place in places:
            _allow(libc, ruleset, place)
        _call(libc, _RESTRICT, ruleset, 0)
    finally:
        os.close(ruleset)
    return True


def places() -> tuple[Path, ...]:
    """Where code is that this process may come to import, and what libraries look up."""
    return tuple(dict.fromkeys((*_code(), *map(Path, SYSTEM))))


def _code() -> Iterator[Path]:
    """The interpreter, the installed packages, and packages that are installed where they are developed (not what lies beside them)."""
    prefixes = [Path(prefix) for prefix in dict.fromkeys((sys.prefix, sys.base_prefix, sys.exec_prefix))]
    yield from prefixes
    for entry in map(Path, sys.path):
        if not entry.is_absolute() or any(entry.is_relative_to(prefix) for prefix in prefixes) or not entry.is_dir():
            continue
        if entry.name in {"site-packages", "dist-packages"}:
            yield entry
        else:
            yield from (path.parent for path in entry.glob("*/__init__.py"))
            yield from (path for path in entry.iterdir() if path.suffix in {".py", ".so"})
    inside = [Path(os.path.realpath(prefix)) for prefix in prefixes]
    for name, module in list(sys.modules.items()):
        if name.startswith("__editable__"):
            yield from map(Path, getattr(module, "MAPPING", {}).values())
        elif "." not in name and (file := getattr(module, "__file__", None)):
            real = Path(os.path.realpath(file))  # a package that is a symlink in its folder
            if not any(real.is_relative_to(prefix) for prefix in inside):
                yield real.parent if real.name == "__init__.py" else real


def _allow(libc: ctypes.CDLL, ruleset: int, place: Path) -> None:
    """Files beneath a folder, and its listing; or one file. What is not there, or not this user's to read, needs no rule."""
    try:
        descriptor = os.open(place, os.O_PATH | os.O_CLOEXEC)
    except OSError:
        return
    try:
        rights = _READ_FILE | (_READ_DIR if place.is_dir() else 0)
        _call(libc, _ADD, ruleset, _PATH_BENEATH, struct.pack("=Qi", rights, descriptor), 0)
    finally:
        os.close(descriptor)


def _call(libc: ctypes.CDLL, number: int, *arguments: object) -> int:
    result: int = libc.syscall(number, *arguments)
    if result < 0:
        error = ctypes.get_errno()
        raise OSError(error, f"landlock: {os.strerror(error)}")
    return result
