"""ArduPilot's own simulator of a rover as a process, and a second MAVLink client beside the runtime: for the experiment and the tests.

The folder holds ArduPilot's program `ardurover` (or `ardurover.xz`) and its parameters `rover-skid.parm`. It is an argument, the
environment variable S2R_SITL, or `../shared/sitl` beside the project, in this order. Each simulator has a working folder and ports of its
own: instance N listens on TCP 5760 + 10 N for the runtime, and two and three ports above for others.
"""

from __future__ import annotations

import lzma
import math
import os
import random
import re
import shutil
import socket
import subprocess
import time
from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from pymavlink.dialects.v20 import common as mavlink

from s2r_runtime.errors import ConfigError

ROOT = Path(__file__).resolve().parent.parent
SETTING, BESIDE = "S2R_SITL", ROOT.parent / "shared" / "sitl"
PROGRAM, PARAMETERS = "ardurover", "rover-skid.parm"
FIRST_PORT, PORTS_EACH = 5760, 10
INSTANCES = range(20, 250)
"""It keeps the number in one byte: 288 would listen on the ports of 32."""
START_S, ANSWER_S = 20.0, 10.0
"""Until it listens; until a parameter is answered."""
RETRY_S = 1.0
ARMED = 0x80
LISTENS = b"Waiting for connection"


def find_folder(argument: Path | None = None) -> Path:
    """The folder with the simulator. Raises ConfigError that says what to do if it is absent."""
    setting = os.environ.get(SETTING)
    folder = argument or (Path(setting) if setting else BESIDE)
    if any((folder / name).is_file() for name in (PROGRAM, f"{PROGRAM}.xz")) and (folder / PARAMETERS).is_file():
        return folder
    raise ConfigError(
        f"no simulator in {folder}: put {PROGRAM} (or {PROGRAM}.xz, ArduPilot Rover built for SITL) and {PARAMETERS} into a folder, "
        f"and name it: --sitl FOLDER or {SETTING}=FOLDER"
    )


def is_available() -> bool:
    """Whether there is a simulator in one of the usual places."""
    try:
        find_folder()
    except ConfigError:
        return False
    return True


class Simulator:
    """A rover in a working folder of its own. Use it as a context, or call `close`."""

    def __init__(self, folder: Path, source: Path) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self._folder = folder
        _unpack(source, folder)
        self._instance = _free_instance()
        self._process: subprocess.Popen[bytes] | None = None
        self.start()

    @property
    def port(self) -> int:
        """For the runtime. `port + 2` and `port + 3` are for others."""
        return FIRST_PORT + PORTS_EACH * self._instance

    @property
    def address(self) -> str:
        """As `transport.robot` of a profile."""
        return f"tcp:127.0.0.1:{self.port}"

    @property
    def pid(self) -> int:
        """Of the process; 0 if there is none."""
        return self._process.pid if self._process is not None else 0

    def start(self) -> None:
        """Returns when it listens. Raises ConfigError with what it said if it does not."""
        argv = [f"./{PROGRAM}", "-I", str(self._instance), "--model", "rover-skid", "--speedup", "1", "--defaults", PARAMETERS]
        said = self._folder / "sitl.txt"
        with said.open("wb") as sink:
            self._process = subprocess.Popen(
                [*argv, "--sim-address", "127.0.0.1"], cwd=self._folder, stdin=subprocess.DEVNULL, stdout=sink, stderr=sink
            )
        limit = time.monotonic() + START_S
        while LISTENS not in said.read_bytes():  # a look at its port would take the port away from it for a moment
            if self._process.poll() is not None or time.monotonic() > limit:
                self.kill()
                raise ConfigError(f"the simulator did not start; it said: {said.read_text(errors='replace')[-500:]}")
            time.sleep(0.1)

    def kill(self) -> None:
        """Ends it without a word, as a power cut would. `start` starts it anew in the same folder, on the same ports."""
        if self._process is not None:
            self._process.kill()
            self._process.wait()
            self._process = None

    close = kill

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.close()


class Client:
    """A second MAVLink client, such as a ground station: parameters, modes, arming. It never sends a velocity."""

    def __init__(self, port: int, system: int = 255) -> None:
        self._socket = _connected(port)
        self._socket.settimeout(0.2)
        self._mav = mavlink.MAVLink(None, system, 190)
        self._mav.robust_parsing = True
        self._beat_s = -math.inf
        self.mode, self.is_armed = -1, False
        self.texts: list[str] = []

    def close(self) -> None:
        """Disconnects."""
        self._socket.close()

    def set_parameter(self, name: str, value: float) -> None:
        """Returns when the robot confirmed it. Raises TimeoutError if it does not."""
        message = self._mav.param_set_encode(1, 1, name.encode(), value, mavlink.MAV_PARAM_TYPE_REAL32)

        def is_confirmed(answer: Any) -> bool:
            return answer.get_type() == "PARAM_VALUE" and answer.param_id == name and math.isclose(answer.param_value, value, rel_tol=1e-5)

        self._until(message, is_confirmed, f"parameter {name} = {value:g}")

    def set_mode(self, number: float) -> None:
        """Returns when the robot is in this mode."""
        message = self._mav.command_long_encode(1, 1, mavlink.MAV_CMD_DO_SET_MODE, 0, 1.0, number, 0, 0, 0, 0, 0)
        self._until(message, lambda _: self.mode == number, f"mode {number:g}")

    def set_streams(self, hz: int) -> None:
        """Asks for all streams at one rate, as ground stations do when they connect."""
        self._socket.sendall(self._mav.request_data_stream_encode(1, 1, mavlink.MAV_DATA_STREAM_ALL, hz, 1).pack(self._mav))

    def listen(self, seconds: float) -> list[Any]:
        """Messages of the robot during that time."""
        heard: list[Any] = []
        limit = time.monotonic() + seconds
        while time.monotonic() < limit:
            heard += self._take()
        return heard

    def _until(self, message: Any, is_there: Callable[[Any], bool], what: str, seconds: float = ANSWER_S) -> Any:
        limit, again = time.monotonic() + seconds, -math.inf
        while (now := time.monotonic()) < limit:
            if now >= again:
                again = now + RETRY_S
                self._socket.sendall(message.pack(self._mav))
            for answer in self._take():
                if is_there(answer):
                    return answer
        raise TimeoutError(f"the robot did not confirm within {seconds:g} s: {what}")

    def _take(self) -> list[Any]:
        if (now := time.monotonic()) - self._beat_s >= 1.0:
            self._beat_s = now
            self._socket.sendall(self._mav.heartbeat_encode(mavlink.MAV_TYPE_GCS, mavlink.MAV_AUTOPILOT_INVALID, 0, 0, 0).pack(self._mav))
        try:
            data = self._socket.recv(1 << 16)
        except TimeoutError:
            return []
        if not data:
            raise TimeoutError("the robot closed the line")
        messages = [m for m in self._mav.parse_buffer(data) or [] if m.get_srcComponent() == 1]
        for m in messages:
            if m.get_type() == "HEARTBEAT":
                self.mode, self.is_armed = m.custom_mode, bool(m.base_mode & ARMED)
            elif m.get_type() == "STATUSTEXT":
                self.texts.append(m.text)
        return messages


def weaken(client: Client, share: float, motors: int = 0xFF) -> None:
    """Lets motors (a bit mask) give only this share of their thrust, as the simulator's own fault injection does."""
    client.set_parameter("SIM_ENGINE_MUL", share)
    client.set_parameter("SIM_ENGINE_FAIL", float(motors))


# ---------------------------------------------------------------- pieces


def _connected(port: int) -> socket.socket:
    """A connection, as soon as there is one. The simulator says that it listens a moment before it does."""
    limit = time.monotonic() + ANSWER_S
    while True:
        try:
            return socket.create_connection(("127.0.0.1", port), ANSWER_S)
        except ConnectionRefusedError:
            if time.monotonic() > limit:
                raise
            time.sleep(0.1)


def _unpack(source: Path, folder: Path) -> None:
    program = folder / PROGRAM
    if not program.exists():
        packed = source / f"{PROGRAM}.xz"
        if packed.is_file():
            program.write_bytes(lzma.decompress(packed.read_bytes()))
        else:
            shutil.copyfile(source / PROGRAM, program)
        program.chmod(0o755)
    (folder / PARAMETERS).write_bytes((source / PARAMETERS).read_bytes())


def _free_instance() -> int:
    """An instance whose ports nobody has; drawn, so that two that look at the same time seldom meet."""
    for number in random.sample(INSTANCES, len(INSTANCES)):
        first = FIRST_PORT + PORTS_EACH * number
        if all(_is_free(port) for port in (first, first + 2, first + 3)):
            return number
    raise ConfigError("no ports are free for a simulator")


def _is_free(port: int) -> bool:
    with socket.socket() as s:
        s.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            s.bind(("", port))
        except OSError:
            return False
    return True


def profile_text(profile: Path, name: str, address: str) -> str:
    """The profile with another robot's name and address, nothing else changed. Raises ConfigError if it has no such lines."""
    text = profile.read_text(encoding="utf-8")
    for old, new in ((r'^name = "rover"$', f'name = "{name}"'), (r'^robot = ".*"$', f'robot = "{address}"')):
        text, count = re.subn(old, new, text, count=1, flags=re.MULTILINE)
        if count != 1:
            raise ConfigError(f"{profile}: has no line like {old}")
    return text
