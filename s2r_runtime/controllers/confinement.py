"""Confines the process that calls it, before it runs code that nobody has read: a controller.

What it can no longer do, from `confine` on, for good and in every thread:

- open a file for writing, create, rename, remove or truncate one, or change its mode or owner
- open a socket, or connect, bind or listen with one: no way to the robot but through the daemon and its gate
- start a process or replace its own (fork, exec); threads are allowed
- signal, trace or write into another process; raise its limits; gain privileges; learn its priority, which is another one while it drives
- hold more memory than it may, dump core, have more than 64 files open
- read a file, unless it is code or something that libraries look up (`reading`; where the kernel has Landlock)

What is **not** contained: it uses processor time until its deadline passes, and between deadlines in threads of its own; it learns
whether a file exists and how long it is; it shares the kernel with everything else. Where the kernel has no Landlock it reads every file
that its user can read, also private keys (what it reads can leave only through its commands and its printed lines, and both are
logged). Where it has no seccomp, or on a processor other than x86-64 and 64-bit ARM, the first four lines do not hold. `confine`
says what is in force. For more, run the daemon in a container or a virtual machine.

The mechanism of the first four is a seccomp filter (seccomp(2)) that makes the system calls below fail with EPERM, which Python turns
into PermissionError: a controller that tries is stopped with a reason. It is a list of what is denied, and not of what is allowed,
because numerical libraries differ in what they need; but system calls that are newer than the list do not exist for it.
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
_CLONE_THREAD = 0x00010000
_WRITING = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND

_AUDIT_ARCH = {"x86_64": 0xC000003E, "aarch64": 0xC00000B7}

# System call numbers: (x86-64, 64-bit ARM); None where it doesn't exist. From asm/unistd_64.h and asm-generic/unistd.h.
_DENIED: dict[str, tuple[int | None, int | None]] = {
    # sockets
    # (a pair as well: one of datagrams may be told to send to any address)
    "socket": (41, 198), "socketpair": (53, 199), "connect": (42, 203), "bind": (49, 200), "listen": (50, 201),
    "accept": (43, 202), "accept4": (288, 242),
    # processes
    "fork": (57, None), "vfork": (58, None), "execve": (59, 221), "execveat": (322, 281), "kill": (62, 129), "tkill": (200, 130),
    "tgkill": (234, 131), "rt_sigqueueinfo": (129, 138), "rt_tgsigqueueinfo": (297, 240), "pidfd_open": (434, 434),
    "pidfd_getfd": (438, 438), "pidfd_send_signal": (424, 424), "ptrace": (101, 117), "process_vm_readv": (310, 270),
    "process_vm_writev": (311, 271), "process_madvise": (440, 440), "kcmp": (312, 272), "setpgid": (109, 154), "setsid": (112, 157),
    "ioprio_set": (251, 30), "move_pages": (279, 239), "migrate_pages": (256, 238),
    "getpriority": (140, 141), "sched_getscheduler": (145, 120), "sched_getparam": (143, 121), "sched_getattr": (315, 275),
    "setpriority": (141, 140), "sched_setaffinity": (203, 122), "sched_setscheduler": (144, 119), "sched_setparam": (142, 118),
    "sched_setattr": (314, 274), "setrlimit": (160, 164), "prctl": (157, 167), "setns": (308, 268), "unshare": (272, 97),
    # files
    "creat": (85, None), "truncate": (76, 45), "rename": (82, None), "renameat": (264, 38), "renameat2": (316, 276), "mkdir": (83, None),
    "mkdirat": (258, 34), "rmdir": (84, None), "link": (86, None), "linkat": (265, 37), "unlink": (87, None), "unlinkat": (263, 35),
    "symlink": (88, None), "symlinkat": (266, 36), "chmod": (90, None), "fchmod": (91, 52), "fchmodat": (268, 53), "fchmodat2": (452, 452),
    "chown": (92, None), "fchown": (93, 55), "lchown": (94, None), "fchownat": (260, 54), "mknod": (133, None), "mknodat": (259, 33),
    "setxattr": (188, 5), "lsetxattr": (189, 6), "fsetxattr": (190, 7), "removexattr": (197, 14), "lremovexattr": (198, 15),
    "fremovexattr": (199, 16), "utime": (132, None), "utimes": (235, None), "utimensat": (280, 88), "futimesat": (261, None),
    "open_by_handle_at": (304, 265), "mq_open": (240, 180), "shmget": (29, 194), "shmat": (30, 196), "msgget": (68, 186),
    "semget": (64, 190), "quotactl": (179, 60),
    # ways around a filter, and what only administrators do
    "io_uring_setup": (425, 425), "io_uring_enter": (426, 426), "io_uring_register": (427, 427), "mount": (165, 40), "umount2": (166, 39),
    "pivot_root": (155, 41), "chroot": (161, 51), "move_mount": (429, 429), "open_tree": (428, 428), "fsopen": (430, 430),
    "fsmount": (432, 432), "mount_setattr": (442, 442), "bpf": (321, 280), "perf_event_open": (298, 241), "userfaultfd": (323, 282),
    "keyctl": (250, 219), "add_key": (248, 217), "request_key": (249, 218), "init_module": (175, 105), "finit_module": (313, 273),
    "delete_module": (176, 106), "kexec_load": (246, 104), "kexec_file_load": (320, 294), "reboot": (169, 142), "swapon": (167, 224),
    "swapoff": (168, 225), "acct": (163, 89), "settimeofday": (164, 170), "clock_settime": (227, 112), "adjtimex": (159, 171),
    "clock_adjtime": (305, 266), "sethostname": (170, 161), "setdomainname": (171, 162), "iopl": (172, None), "ioperm": (173, None),
}  # fmt: skip

_NEWER = 463
"""The first system call that is newer than this list (setxattrat, Linux 6.13); the same number on both processors."""
_OWNERS = (8, 10, 15)
"""fcntl(2): F_SETOWN, F_SETSIG, F_SETOWN_EX. A pipe that has data for somebody sends him a signal of one's choice."""
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

    Returns what is in force: `memory`, `files` (limits), `privileges` (no_new_privs), `reading` (Landlock), `system_calls` (the filter).
    """
    readable = reading.places()
    _limit(resource.RLIMIT_AS, -(-_address_space() // _ROUND) * _ROUND + memory_bytes)
    _limit(resource.RLIMIT_NOFILE, FILES_MAX)
    _limit(resource.RLIMIT_FSIZE, 0)
    _limit(resource.RLIMIT_CORE, 0)
    in_force = ["memory", "files"]
    with contextlib.suppress(OSError):
        _prctl(_PR_SET_NO_NEW_PRIVS, 1)
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
    for calls, answer in ((_DENIED, deny), (_UNKNOWN, unknown)):
        for numbers in calls.values():
            if (number := numbers[column]) is not None:
                code += [_op(_JUMP_EQUAL, number, 0, 1), _op(_RETURN, answer)]
    # clone: threads only. open, openat: reading only. prlimit64: asking only (its third argument is the new limit's address).
    code += _when((56, 220)[column], _low(0), [_op(_JUMP_BITS, _CLONE_THREAD, 1, 0), _op(_RETURN, deny)])
    if machine == "x86_64":
        code += _when(2, _low(1), [_op(_JUMP_BITS, _WRITING, 0, 1), _op(_RETURN, deny)])
    code += _when((257, 56)[column], _low(2), [_op(_JUMP_BITS, _WRITING, 0, 1), _op(_RETURN, deny)])
    code += _when((72, 25)[column], _low(1), _none_of(_OWNERS, deny))
    code += _when((16, 29)[column], _low(1), _none_of(_IOCTL_OWNERS, deny))
    zero = [_op(_JUMP_EQUAL, 0, 1, 0), _op(_RETURN, deny)]
    code += _when((302, 261)[column], _low(2), [*zero, _op(_LOAD, _low(2) + 4), *zero])
    code.append(_op(_RETURN, _ALLOW))
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
