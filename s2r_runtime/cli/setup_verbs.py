"""Verbs that set things up and look at them: profile, doctor."""

from __future__ import annotations

import argparse
import contextlib
import os
import platform
import shutil
import socket
import subprocess
import sys
import sysconfig
from collections.abc import Iterator
from importlib import metadata
from pathlib import Path
from typing import NamedTuple

import msgspec

from s2r_runtime.cli import output
from s2r_runtime.errors import S2RError
from s2r_runtime.files.printable import printable
from s2r_runtime.profile import Gate, Machine, Recording, load_profile

MINIMUM_FREE_BYTES = 1_000_000_000
"""A day of a 100 Hz log is about 2 GB; below half of that a robot should not start a mission."""


IDLE_S, LOADED_S = 2.0, 10.0
"""For how long the computer is tried. Waits of a second come some times in ten of a busy one."""


def add(verbs: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Adds the verbs of this module."""
    profile = verbs.add_parser("profile").add_subparsers(dest="what", metavar="WHAT", required=True)
    check = profile.add_parser("check", help="is this profile valid here, and what does it mean")
    check.add_argument("profile", type=Path, metavar="PROFILE", help="the robot's profile (TOML)")
    check.add_argument("--defaults", action="store_true", help="print every setting in force, the defaults included")
    check.add_argument("--json", action="store_true", help="print one JSON object")
    check.set_defaults(run=profile_check)

    doctor = verbs.add_parser("doctor")
    doctor.add_argument(
        "--load", action="store_true", help="try the computer beside as many busy loops as it has processors, for 10 s; else idle, for 2 s"
    )
    doctor.add_argument(
        "--profile",
        type=Path,
        metavar="PROFILE",
        help="the robot's profile whose times are to be held (default: those of a profile's defaults)",
    )
    doctor.add_argument("--json", action="store_true", help="print one JSON object")
    doctor.set_defaults(run=doctor_run)


def profile_check(args: argparse.Namespace) -> int:
    """Exit 0 if the profile is valid here; otherwise ConfigError says what is wrong."""
    from s2r_runtime.api.models import load_checked

    profile = load_checked(args.profile)
    if args.json:
        output.result_json(
            {
                "ok": True,
                "robot": profile.robot.name,
                "digest": profile.digest(),
                "model_digest": profile.model.digest(),
                "settings": msgspec.to_builtins(profile),
            }
        )
        return 0
    model, transport = f"model {profile.model.name} at {profile.model.dt} s", profile.transport.get("name", "none (nobody can drive)")
    output.out(f"{args.profile}: valid. Robot {profile.robot.name!r}, {model}, task {profile.task.name}, transport {transport}.")
    if args.defaults:
        for table, values in msgspec.to_builtins(profile).items():
            output.out(f"{table} = {msgspec.json.encode(values).decode()}")
    return 0


class Finding(NamedTuple):
    """One thing looked at. `ok` None: not needed for everything, said for information."""

    what: str
    ok: bool | None
    detail: str
    mend: str = ""


def doctor_run(args: argparse.Namespace) -> int:
    """Exit 0 if nothing that is needed is missing, else 1."""
    findings = [*_findings(), *_computer(args.profile, loaded=args.load)]
    if args.json:
        output.result_json({"ok": all(f.ok is not False for f in findings), "findings": [f._asdict() for f in findings]})
    else:
        for f in findings:
            mark = {
                True: output.styled("ok     ", "green"),
                False: output.styled("missing", "red"),
                None: output.styled("note   ", "yellow"),
            }[f.ok]
            output.out_lines(f"{mark} {f.what}: {printable(f.detail)}" + (f"\n        → {f.mend}" if f.mend else ""))
    return 1 if any(f.ok is False for f in findings) else 0


def _findings() -> Iterator[Finding]:
    ok = sys.version_info >= (3, 11)
    yield Finding("Python", ok, platform.python_version(), "" if ok else "install Python 3.11 or newer")
    known = sys.platform == "linux" and platform.machine() in {"x86_64", "aarch64"}
    yield Finding(
        "platform", known or None, f"{sys.platform} {sysconfig.get_platform()}", "" if known else "tested on Linux x86-64 and aarch64 only"
    )
    yield from _packages()
    yield from _plugins()
    yield _loopback()
    free = shutil.disk_usage(Path.home() if Path.home().exists() else Path("/")).free
    yield Finding(
        "disk",
        free > MINIMUM_FREE_BYTES,
        f"{free / 1e9:.1f} GB free in the home folder",
        "" if free > MINIMUM_FREE_BYTES else "free some: a full disk closes the gate",
    )
    yield _key()
    yield _confinement()
    yield _governor()
    under = bool(os.environ.get("NOTIFY_SOCKET"))
    systemd = shutil.which("systemctl") is not None
    yield Finding(
        "systemd",
        None if not systemd else True,
        "notify socket present" if under else "available" if systemd else "not on this machine",
        "" if systemd else "without it nothing restarts the daemon; see docs/install.md",
    )


def _packages() -> Iterator[Finding]:
    for name, needed_for in (
        ("numpy", ""),
        ("scipy", ""),
        ("mcap", ""),
        ("zstandard", ""),
        ("cryptography", ""),
        ("msgspec", ""),
        ("matplotlib", "s2r report"),
    ):
        try:
            yield Finding(name, True, metadata.version(name))
        except metadata.PackageNotFoundError:
            yield Finding(
                name,
                None if needed_for else False,
                "not installed" + (f" (for {needed_for})" if needed_for else ""),
                "pip install 's2r-runtime[report]'" if needed_for else f"pip install {name}",
            )


def _plugins() -> Iterator[Finding]:
    from s2r_runtime.plugins import registry

    found = registry()
    for plugin in found.loaded:
        if plugin.error:
            yield Finding(f"plug-in {plugin.name}", False, plugin.error, f"pip install --upgrade {plugin.distribution}")
    transports = found.names("transports")
    yield Finding("transports", bool(transports), ", ".join(transports) or "none", "" if transports else "pip install s2r-zenoh")
    robots = found.names("robots")
    yield Finding(
        "built-in robots",
        True if robots else None,
        ", ".join(robots) or "none",
        "" if robots else "pip install s2r-standins (for s2r demo)",
    )


def _loopback() -> Finding:
    try:
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
    except OSError as error:
        return Finding("loopback", False, f"cannot listen on 127.0.0.1: {error.strerror}", "bring up the interface lo")
    return Finding("loopback", True, "can listen on 127.0.0.1")


def _key() -> Finding:
    from s2r_runtime.trust import keys

    path = keys.default_path()
    if not path.exists():
        return Finding("signing key", None, f"none at {path}", "s2r keys new (the daemon makes one of its own for a robot that has none)")
    try:
        keys.load(path)
    except S2RError as error:
        return Finding("signing key", False, str(error), "")
    return Finding("signing key", True, str(path))


def _confinement() -> Finding:
    """What a controller's process can be kept from here: tried in one."""
    from s2r_runtime.controllers.confinement import ALL

    program = "from s2r_runtime.controllers.confinement import confine; print(*confine(1 << 30))"
    tried = subprocess.run([sys.executable, "-P", "-c", program], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True, check=False)
    lacking = [name for name in ALL if name not in tried.stdout.split()]
    if not lacking:
        return Finding("confinement", True, "controllers can compute, import and answer, and nothing else")
    mend = "docs/threat-model.md says what that leaves open; reading takes Landlock, Linux 5.13 or newer"
    return Finding("confinement", None, f"this kernel does not contain a controller's {', '.join(lacking)}", mend)


@contextlib.contextmanager
def _busy(loops: int) -> Iterator[None]:
    """So many processes that compute without end beside."""
    busy = [subprocess.Popen([sys.executable, "-S", "-c", "while True: pass"]) for _ in range(loops)]
    try:
        yield
    finally:
        for one in busy:
            one.kill()
            one.wait()


def _computer(path: Path | None, *, loaded: bool) -> Iterator[Finding]:
    """Whether this computer holds the times of the profile: a finding for each that it doesn't."""
    from s2r_runtime.daemon import computer, control

    profile = load_profile(path) if path is not None else None
    folder = next(one for one in (control.state_root(), *control.state_root().parents) if one.is_dir())
    with _busy(os.cpu_count() or 1 if loaded else 0):
        ability = computer.measure(folder, LOADED_S if loaded else IDLE_S)
    how = f"beside {os.cpu_count() or 1} busy loops" if loaded else "as it is now"
    yield Finding("computer", True, f"{how}, it {ability}")
    gate, recording, machine, clock = (
        (profile.gate, profile.recording, profile.machine, profile.clock)
        if profile is not None
        else (Gate(), Recording(), Machine(), "realtime")
    )
    for line in computer.not_held(ability, gate, recording, machine, realtime=clock != "lockstep"):
        yield Finding("computer", None, line)


def _governor() -> Finding:
    governor = Path("/sys/devices/system/cpu/cpu0/cpufreq/scaling_governor")
    if not governor.exists():
        return Finding("CPU governor", True, "not adjustable here")
    name = governor.read_text(encoding="ascii").strip()
    return Finding(
        "CPU governor",
        True if name == "performance" else None,
        name,
        "" if name == "performance" else "'performance' gives the steadiest latency",
    )
