"""Confines the process that calls it, before it runs code that nobody has read: a controller.

What it can no longer do, from `confine` on, for good and in every thread:

- open a file for writing, create, rename, remove or truncate one, or change its mode or owner
- open a socket, or connect, bind or listen with one: no way to the robot but through the daemon and its gate
- start a process or replace its own (fork, exec); threads are allowed
- signal, trace or write into another process; raise its limits; gain privileges; learn its priority, which is another one while it drives.
  Root's capabilities are dropped, so root is a user there who owns root's files
- use message queues, semaphores and shared memory of System V and POSIX, remove those of others, or watch files (inotify, fanotify)
- hold more memory than it may, dump core, have more than 64 files open
- read a file, unless it is code or something that libraries look up (`reading`; where the kernel has Landlock)

What is **not** contained: it uses processor time until its deadline passes, and between deadlines in threads of its own; it learns
whether a file exists and how long it is; it shares the kernel with everything else. Where the kernel has no Landlock it reads every file
that its user can read, also private keys (what it reads can leave only through its commands and its printed lines, and both are
logged). Where it has no seccomp, or on a processor other than x86-64 and 64-bit ARM, the first five lines do not hold. `confine`
says what is in force. For more, run the daemon in a container or a virtual machine.

The mechanism of the first five is a seccomp filter (seccomp(2)) with a list of the system calls that computing needs: numbers on open
descriptors, memory, threads, clocks, reading. Every other fails with EPERM, which Python turns into PermissionError: a controller that
tries is stopped with a reason. Calls that are newer than the list do not exist for it (ENOSYS), so that libraries fall back to older ones.
"""

from __future__ import annotations

import contextlib
import ctypes
import errno
import os
import platform
import resource
import struct

from s2r_runtime.controllers import reading

FILES_MAX = 64

_PR_SET_NO_NEW_PRIVS, _PR_SET_SECCOMP, _SECCOMP_MODE_FILTER = 38, 22, 2  # prctl(2)
_ALLOW, _ERRNO, _KILL = 0x7FFF0000, 0x00050000, 0x80000000  # seccomp(2): SECCOMP_RET_*
_LOAD, _JUMP_EQUAL, _JUMP_ABOVE, _JUMP_BITS, _RETURN = 0x20, 0x15, 0x35, 0x45, 0x06  # BPF_LD|W|ABS, BPF_JMP|JEQ|K, JGE, JSET, BPF_RET
_NUMBER, _ARCH, _ARGUMENTS = 0, 4, 16  # offsets in struct seccomp_data; both processors are little-endian
_CAPABILITY_VERSION = 0x20080522  # _LINUX_CAPABILITY_VERSION_3
_CLONE_THREAD = 0x00010000
_WRITING = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND

_AUDIT_ARCH = {"x86_64": 0xC000003E, "aarch64": 0xC00000B7}

# System call numbers: (x86-64, 64-bit ARM); None where it doesn't exist. From asm/unistd_64.h and asm-generic/unistd.h.
_ALLOWED: dict[str, tuple[int | None, int | None]] = {
    # the channel to the daemon, and descriptors that are open
    "read": (0, 63), "write": (1, 64), "recvfrom": (45, 207), "sendto": (44, 206), "recvmsg": (47, 212), "sendmsg": (46, 211),
    "readv": (19, 65), "writev": (20, 66), "pread64": (17, 67), "preadv": (295, 69), "preadv2": (327, 286), "pwrite64": (18, 68),
    "pwritev": (296, 70), "pwritev2": (328, 287), "lseek": (8, 62), "close": (3, 57), "close_range": (436, 436), "dup": (32, 23),
    "dup2": (33, None), "dup3": (292, 24), "pipe": (22, None), "pipe2": (293, 59), "shutdown": (48, 210), "getsockname": (51, 204),
    "getsockopt": (55, 209), "poll": (7, None), "ppoll": (271, 73), "select": (23, None), "pselect6": (270, 72),
    "epoll_create": (213, None), "epoll_create1": (291, 20), "epoll_ctl": (233, 21), "epoll_wait": (232, None), "epoll_pwait": (281, 22),
    "epoll_pwait2": (441, 441), "eventfd": (284, None), "eventfd2": (290, 19), "signalfd": (282, None), "signalfd4": (289, 74),
    # memory
    "brk": (12, 214), "mmap": (9, 222), "munmap": (11, 215), "mremap": (25, 216), "mprotect": (10, 226), "madvise": (28, 233),
    "msync": (26, 227), "mincore": (27, 232), "mlock": (149, 228), "munlock": (150, 229), "mlock2": (325, 284), "membarrier": (324, 283),
    "memfd_create": (319, 279), "ftruncate": (77, 46), "mbind": (237, 235), "set_mempolicy": (238, 237), "get_mempolicy": (239, 236),
    "pkey_alloc": (330, 289), "pkey_free": (331, 290), "pkey_mprotect": (329, 288),
    # threads, and signals of its own
    "futex": (202, 98), "futex_waitv": (449, 449), "set_robust_list": (273, 99), "get_robust_list": (274, 100),
    "set_tid_address": (218, 96), "rseq": (334, 293), "arch_prctl": (158, None), "sched_yield": (24, 124), "rt_sigaction": (13, 134),
    "rt_sigprocmask": (14, 135), "rt_sigreturn": (15, 139), "rt_sigpending": (127, 136), "rt_sigsuspend": (130, 133),
    "rt_sigtimedwait": (128, 137), "sigaltstack": (131, 132), "restart_syscall": (219, 128), "pause": (34, None), "exit": (60, 93),
    "exit_group": (231, 94), "wait4": (61, 260), "waitid": (247, 95),
    # time
    "clock_gettime": (228, 113), "clock_getres": (229, 114), "clock_nanosleep": (230, 115), "nanosleep": (35, 101),
    "gettimeofday": (96, 169), "time": (201, None), "times": (100, 153), "alarm": (37, None), "getitimer": (36, 102),
    "setitimer": (38, 103), "timer_create": (222, 107), "timer_settime": (223, 110), "timer_gettime": (224, 108),
    "timer_getoverrun": (225, 109), "timer_delete": (226, 111), "timerfd_create": (283, 85), "timerfd_settime": (286, 86),
    "timerfd_gettime": (287, 87),
    # what it is, and where it runs
    "getpid": (39, 172), "gettid": (186, 178), "getppid": (110, 173), "getuid": (102, 174), "geteuid": (107, 175), "getgid": (104, 176),
    "getegid": (108, 177), "getresuid": (118, 148), "getresgid": (120, 150), "getgroups": (115, 158), "getpgid": (121, 155),
    "getpgrp": (111, None), "getsid": (124, 156), "getrlimit": (97, 163), "getrusage": (98, 165),
    "getcpu": (309, 168), "getrandom": (318, 278), "uname": (63, 160), "sysinfo": (99, 179), "umask": (95, 166),
    "sched_getaffinity": (204, 123),
    "sched_get_priority_max": (146, 125), "sched_get_priority_min": (147, 126),
    # what files there are (Landlock says which can be opened)
    "stat": (4, None), "fstat": (5, 80), "lstat": (6, None), "newfstatat": (262, 79), "statx": (332, 291), "statfs": (137, 43),
    "fstatfs": (138, 44), "access": (21, None), "faccessat": (269, 48), "faccessat2": (439, 439), "readlink": (89, None),
    "readlinkat": (267, 78), "getdents": (78, None), "getdents64": (217, 61), "getcwd": (79, 17), "chdir": (80, 49), "fchdir": (81, 50),
    "getxattr": (191, 8), "lgetxattr": (192, 9), "fgetxattr": (193, 10), "listxattr": (194, 11), "llistxattr": (195, 12),
    "flistxattr": (196, 13), "fadvise64": (221, 223), "readahead": (187, 213),
}  # fmt: skip
"""All else is refused, but for the calls whose arguments decide (`_filter`), which looks at them in this order."""

_NEWER = 463
"""The first system call that is newer than this list (setxattrat, Linux 6.13); the same number on both processors."""
_REACHING = (6, 7, 8, 10, 15, 37, 38, 1024, 1026)
"""fcntl(2): F_SETOWN, F_SETSIG, F_SETOWN_EX: a pipe that has data for somebody sends him a signal of one's choice. F_SETLEASE: whoever
opens the file for writing waits for its holder, 45 s. F_NOTIFY: watches a folder. F_SETLK, F_SETLKW, F_OFD_SETLK, F_OFD_SETLKW (and
flock, which is not on the list): others wait for whoever locks their files.
"""
_IOCTL_OWNERS = (0x5452, 0x8901, 0x8902)
"""ioctl(2): FIOASYNC, FIOSETOWN, SIOCSPGRP, which do the same."""

# Their arguments are in memory, where a filter cannot look; the C library falls back to clone and openat.
_UNKNOWN = {"clone3": (435, 435), "openat2": (437, 437)}


_ROUND = 1 << 28
"""Bytes. So the limit of memory, which a controller can read, is the same in every process of its."""

ALL = ("memory", "files", "privileges", "reading", "system_calls")
"""What is in force where the kernel has it all."""


def confine(memory_bytes: int) -> tuple[str, ...]:
    """Confines this process; `memory_bytes` is what it may have beyond the address space it has now.

    Returns what is in force: `memory`, `files` (limits), `privileges` (no_new_privs, no capabilities), `reading` (Landlock),
    `system_calls` (the filter).
    """
    readable = reading.places()
    _limit(resource.RLIMIT_AS, -(-_address_space() // _ROUND) * _ROUND + memory_bytes)
    _limit(resource.RLIMIT_NOFILE, FILES_MAX)
    _limit(resource.RLIMIT_FSIZE, 0)
    _limit(resource.RLIMIT_CORE, 0)
    in_force = ["memory", "files"]
    with contextlib.suppress(OSError):
        _prctl(_PR_SET_NO_NEW_PRIVS, 1)
        _drop_capabilities()
        in_force.append("privileges")
        if reading.restrict(readable):
            in_force.append("reading")
    with contextlib.suppress(OSError):
        if program := _filter(platform.machine()):
            _prctl(_PR_SET_SECCOMP, _SECCOMP_MODE_FILTER, program)
            in_force.append("system_calls")
    if "system_calls" not in in_force:
        _limit(resource.RLIMIT_NPROC, 0)  # no process and no thread more, unless this is root
    return tuple(in_force)


def _limit(which: int, value: int) -> None:
    """Sets soft and hard limit, never above the hard one there is."""
    hard = resource.getrlimit(which)[1]
    value = value if hard == resource.RLIM_INFINITY else min(value, hard)
    resource.setrlimit(which, (value, value))


def _address_space() -> int:
    """Bytes of address space this process has now."""
    with open("/proc/self/statm", "rb") as file:  # noqa: PTH123 - one line of a pseudo-file
        return int(file.read().split()[0]) * resource.getpagesize()


def _drop_capabilities() -> None:
    """All of them, for good: with no_new_privs nothing gives them back. Raises OSError."""
    header = struct.pack("=Ii", _CAPABILITY_VERSION, 0)
    if ctypes.CDLL(None, use_errno=True).capset(header, bytes(24)) != 0:  # effective, permitted, inheritable, twice 32 bits each
        raise OSError(ctypes.get_errno(), "capset")


def _prctl(option: int, first: int, program: bytes | None = None) -> None:
    libc = ctypes.CDLL(None, use_errno=True)
    pointer = None
    if program is not None:
        code = ctypes.create_string_buffer(program, len(program))
        # struct sock_fprog: the number of instructions, padding, the address
        pointer = ctypes.create_string_buffer(struct.pack("@HxxxxxxP", len(program) // 8, ctypes.addressof(code)))
    unused = ctypes.c_ulong(0)
    if libc.prctl(option, ctypes.c_ulong(first), pointer if pointer is not None else unused, unused, unused) != 0:
        raise OSError(ctypes.get_errno(), "prctl")


def _filter(machine: str) -> bytes | None:
    """The filter's program for a processor, or None if its system calls are not known here. 8 bytes an instruction."""
    if machine not in _AUDIT_ARCH:
        return None
    column = list(_AUDIT_ARCH).index(machine)
    deny, unknown = _ERRNO | errno.EPERM, _ERRNO | errno.ENOSYS
    code = [
        *(_op(_LOAD, _ARCH), _op(_JUMP_EQUAL, _AUDIT_ARCH[machine], 1, 0), _op(_RETURN, _KILL)),  # another processor's numbers
        _op(_LOAD, _NUMBER),
    ]
    if machine == "x86_64":
        code += [_op(_JUMP_ABOVE, 0x40000000, 0, 1), _op(_RETURN, deny)]  # the x32 numbers of the same calls
    code += [_op(_JUMP_ABOVE, _NEWER, 0, 1), _op(_RETURN, unknown)]
    for calls, answer in ((_ALLOWED, _ALLOW), (_UNKNOWN, unknown)):
        for numbers in calls.values():
            if (number := numbers[column]) is not None:
                code += [_op(_JUMP_EQUAL, number, 0, 1), _op(_RETURN, answer)]
    # clone: threads only. open, openat: reading only. prlimit64: asking only (its third argument is the new limit's address).
    code += _when((56, 220)[column], _low(0), [_op(_JUMP_BITS, _CLONE_THREAD, 1, 0), _op(_RETURN, deny)])
    if machine == "x86_64":
        code += _when(2, _low(1), [_op(_JUMP_BITS, _WRITING, 0, 1), _op(_RETURN, deny)])
    code += _when((257, 56)[column], _low(2), [_op(_JUMP_BITS, _WRITING, 0, 1), _op(_RETURN, deny)])
    code += _when((72, 25)[column], _low(1), _none_of(_REACHING, deny))
    code += _when((16, 29)[column], _low(1), _none_of(_IOCTL_OWNERS, deny))
    zero = [_op(_JUMP_EQUAL, 0, 1, 0), _op(_RETURN, deny)]
    code += _when((302, 261)[column], _low(2), [*zero, _op(_LOAD, _low(2) + 4), *zero])
    code.append(_op(_RETURN, deny))
    return b"".join(code)


def _when(number: int, argument: int, then: list[bytes]) -> list[bytes]:
    """If the call has this number: load that argument, run `then`, and allow what it didn't deny."""
    return [_op(_JUMP_EQUAL, number, 0, len(then) + 2), _op(_LOAD, argument), *then, _op(_RETURN, _ALLOW)]


def _none_of(values: tuple[int, ...], deny: int) -> list[bytes]:
    """What is loaded is none of these."""
    return [part for value in values for part in (_op(_JUMP_EQUAL, value, 0, 1), _op(_RETURN, deny))]


def _low(argument: int) -> int:
    """Offset of an argument's low 32 bits; flags have no others."""
    return _ARGUMENTS + 8 * argument


def _op(code: int, k: int, if_true: int = 0, if_false: int = 0) -> bytes:
    """struct sock_filter."""
    return struct.pack("=HBBI", code, if_true, if_false, k)
