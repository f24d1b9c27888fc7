"""The control socket: how `s2r status`, `deploy`, `revoke` and the others talk to the daemon of this machine.

A Unix socket `<robot>.sock` (0600) in a folder of its owner's (0700); the kernel names the peer's user, and only the owner and
root are heard. One connection is one request: a JSON line `{"verb": ...}`, answered by any number of progress lines and one final
line that has `exit_code`, `text` and `data`. A client that waits may send one line more, `{"verb": "interrupt", "text": WHY}`: it wants
no more of it, and hears what became of it. A client that hangs up means the same. The server never waits for a client: requests are
bounded and must arrive in time, and a client that doesn't read its answers is dropped.
"""

from __future__ import annotations

import contextlib
import json
import os
import selectors
import socket
import stat
import struct
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Protocol

from s2r_runtime.daemon import door
from s2r_runtime.errors import ConfigError, S2RError, UsageError, one_line
from s2r_runtime.files.toml_text import TEXT_MAX

REQUEST_MAX = TEXT_MAX + (1 << 20)
"""Of a line: the text of the largest model that is read, and what JSON adds. It is scanned in a millisecond or two (`door`)."""
ANSWER_MAX = 8 << 20
CLIENTS_MAX = 32
REQUEST_WITHIN_NS = 5_000_000_000
FIRST_LINE_WITHIN_S = 45.0
"""Longer than the daemon's loop may wait for a disk: 30 s, in lockstep."""
INTERRUPTED_WITHIN_S = 10.0
"""For the answer to an interrupted request; the robot is stopped long before."""
INTERRUPT_MAX = 4096
GONE = "its command is gone"
_PATH_MAX = 107  # sun_path of unix(7), less the final zero

Request = dict[str, Any]


def socket_dir() -> Path:
    """Where this user's sockets are: the service's RUNTIME_DIRECTORY, else XDG_RUNTIME_DIR, else the user's state folder."""
    if given := os.environ.get("RUNTIME_DIRECTORY"):
        return Path(given.split(":")[0])
    if given := os.environ.get("XDG_RUNTIME_DIR"):
        return Path(given) / "s2r"
    return state_root() / "run"


def state_root() -> Path:
    """Where robots' state folders are, unless told otherwise."""
    base = os.environ.get("XDG_STATE_HOME")
    return (Path(base) if base else Path.home() / ".local" / "state") / "s2r"


# ---------------------------------------------------------------- server


class Connection:
    """One client. `answer` keeps what it doesn't take at once; `gone` once it hung up."""

    def __init__(self, server: ControlServer, sock: socket.socket, uid: int, deadline_ns: int) -> None:
        self.uid, self.gone, self.deadline_ns = uid, False, deadline_ns
        self._server, self._sock = server, sock
        self._in, self._out = bytearray(), bytearray()
        self._asked = self._final = False

    def progress(self, **fields: Any) -> None:
        """A line on the way: `text`, or `done`, `total`, `detail`."""
        self._put(fields)

    def answer(self, exit_code: int, text: str, data: object = None) -> None:
        """The final line; the connection closes after it."""
        self._put({"exit_code": exit_code, "text": text, "data": data})
        self._final = True
        self._flush()

    def close(self) -> None:
        """Hangs up; may be called twice."""
        if not self.gone:
            self.gone = True
            self._server.forget(self, self._sock)
            self._sock.close()
            if not self._final:
                self._server.left(self, GONE)

    @property
    def listening(self) -> bool:
        """Whether its final answer is still awaited."""
        return not (self.gone or self._final)

    def waiting(self) -> bool:
        """Whether its request is not there yet."""
        return not self._asked

    def ready(self, mask: int) -> None:
        """Called by the loop when the socket can be read or written."""
        if mask & selectors.EVENT_WRITE:
            self._flush()
        if mask & selectors.EVENT_READ and not self.gone:
            self._receive()

    def _receive(self) -> None:
        try:
            data = self._sock.recv(1 << 16)
        except BlockingIOError:
            return
        except OSError:
            data = b""
        if not data:
            self.close()
        elif not self._asked:
            first, ended, _ = data.partition(b"\n")
            self._in += first
            if ended:
                self._asked = True
                self._server.handle(self, bytes(self._in))
                self._in.clear()
            elif len(self._in) > REQUEST_MAX:
                self._asked = True
                self.answer(2, f"the request is longer than {REQUEST_MAX} bytes")
        elif self.listening:
            self._in += data
            line, end, _ = self._in.partition(b"\n")
            if end or len(self._in) > INTERRUPT_MAX:
                self._in.clear()
                self._server.left(self, _reason(bytes(line)))

    def _put(self, fields: dict[str, Any]) -> None:
        if self.gone or self._final:
            return
        self._out += json.dumps(fields, allow_nan=False).encode() + b"\n"
        self._flush()

    def _flush(self) -> None:
        try:
            while self._out and not self.gone:
                del self._out[: self._sock.send(self._out)]
        except BlockingIOError:
            if len(self._out) > ANSWER_MAX:
                self.close()
                return
        except OSError:
            self.close()
            return
        if not self.gone:
            if self._final and not self._out:
                self.close()
            else:
                self._server.interest(self, self._sock, writing=bool(self._out))


class ControlServer:
    """Listens for the daemon. `on_request(connection, request)` is called for each well-formed request."""

    def __init__(
        self,
        path: Path,
        selector: selectors.BaseSelector,
        on_request: Callable[[Connection, door.Request], None],
        on_left: Callable[[Connection, str], None] | None = None,
    ) -> None:
        """on_left(connection, why): a client hung up, or wants no more of its request (then it still listens)."""
        self.path = path
        self._selector, self._on_request, self._on_left = selector, on_request, on_left
        self._socket: socket.socket | None = None
        self._clients: list[Connection] = []

    def open(self) -> None:
        """Binds. Raises ConfigError where that is impossible, or another daemon listens there."""
        if len(os.fsencode(self.path)) > _PATH_MAX:
            raise ConfigError(f"{self.path}: the path of a socket must be at most {_PATH_MAX} bytes; set XDG_RUNTIME_DIR to a shorter one")
        if _listening(self.path):
            raise ConfigError(f"{self.path}: already running: a daemon of this robot listens there")
        sock = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM | socket.SOCK_CLOEXEC | socket.SOCK_NONBLOCK)
        try:
            self.path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
            _check_owner(self.path.parent)
            self.path.unlink(missing_ok=True)  # left by a daemon that was killed
            sock.bind(str(self.path))  # between here and chmod the folder's 0700 keeps others out
            self.path.chmod(0o600)
            sock.listen(CLIENTS_MAX)
        except OSError as error:
            sock.close()
            raise ConfigError(f"{self.path}: cannot listen: {error.strerror}") from None
        except ConfigError:
            sock.close()
            raise
        self._socket = sock
        self._selector.register(sock, selectors.EVENT_READ, self._accept)

    def tick(self, now_ns: int) -> None:
        """Drops clients whose request doesn't come."""
        for client in [c for c in self._clients if c.waiting() and now_ns > c.deadline_ns]:
            client.close()

    def close(self) -> None:
        """Hangs up on everybody and removes the socket; may be called twice."""
        self._on_left = None
        for client in list(self._clients):
            client.close()
        if self._socket is not None:
            self._selector.unregister(self._socket)
            self._socket.close()
            self._socket = None
            self.path.unlink(missing_ok=True)

    def handle(self, client: Connection, line: bytes) -> None:
        """Decodes a request line and hands it on."""
        try:
            request = door.decode_request(line)
        except S2RError as error:
            client.answer(error.exit_code, str(error))
            return
        client.progress(accepted=True)
        self._on_request(client, request)

    def left(self, client: Connection, why: str) -> None:
        """A client is gone, or interrupted its request."""
        if self._on_left is not None:
            self._on_left(client, why)

    def interest(self, client: Connection, sock: socket.socket, *, writing: bool) -> None:
        """Whether the loop is to call when the socket can be written."""
        mask = selectors.EVENT_READ | (selectors.EVENT_WRITE if writing else 0)
        if self._selector.get_key(sock).events != mask:
            self._selector.modify(sock, mask, client.ready)

    def forget(self, client: Connection, sock: socket.socket) -> None:
        """A connection is closing."""
        self._selector.unregister(sock)
        self._clients.remove(client)

    def _accept(self, _mask: int) -> None:
        assert self._socket is not None  # noqa: S101 - registered only while open
        try:
            sock, _ = self._socket.accept()
        except OSError:  # it hung up already, or we are out of descriptors: the listener stays
            return
        sock.setblocking(False)
        uid = _peer(sock)
        client = Connection(self, sock, uid, time.monotonic_ns() + REQUEST_WITHIN_NS)
        self._selector.register(sock, selectors.EVENT_READ, client.ready)
        self._clients.append(client)
        if uid not in (0, os.getuid()):
            client.answer(2, f"user {uid} may not talk to this daemon; it belongs to user {os.getuid()}")
        elif len(self._clients) > CLIENTS_MAX:
            client.answer(70, "too many clients at once; try again")


def _reason(line: bytes) -> str:
    """Why a client interrupts its request, as printable text."""
    try:
        said = json.loads(line)["text"]
    except (ValueError, RecursionError, KeyError, TypeError, IndexError):
        said = ""
    return "".join(filter(str.isprintable, said[:100])) if isinstance(said, str) and said else "interrupted"


def _peer(sock: socket.socket) -> int:
    """The user at the other end, as the kernel has it from when he connected, or began to listen."""
    return int(struct.unpack("3i", sock.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, struct.calcsize("3i")))[1])


def _placed_by_root(path: Path, whose: int) -> bool:
    """Whether only root can have given that user the folder of this socket, as for a service: then root believes who listens there."""
    folder = path.resolve().parent
    status, above = folder.stat(), [parent.stat() for parent in folder.parents]
    return status.st_uid == whose and not any(one.st_uid or one.st_mode & 0o022 for one in above) and not status.st_mode & 0o022


def _check_owner(folder: Path) -> None:
    """Refuses a folder that somebody else owns or may write to. Raises ConfigError."""
    status = folder.stat()
    if status.st_uid not in (0, os.getuid()):
        raise ConfigError(f"{folder}: belongs to user {status.st_uid}; the control socket's folder must be this user's")
    if stat.S_IMODE(status.st_mode) & 0o077 and status.st_uid == os.getuid():
        folder.chmod(0o700)


# ---------------------------------------------------------------- client


def find_socket(robot: str | None = None, *, required: bool = True) -> Path | None:
    """The socket of the running daemon (of that robot). None if there is none and none is required.

    Raises UsageError when there is none, or when there are several and no robot was named.
    """
    folders = list(dict.fromkeys([socket_dir(), state_root() / "run", Path("/run/s2r")]))
    found: dict[str, Path] = {}
    for folder in folders:
        with contextlib.suppress(OSError):
            for path in sorted(folder.glob("*.sock")):
                if _listening(path):
                    found.setdefault(path.stem, path)
    if robot is not None:
        found = {name: path for name, path in found.items() if name == robot}
    if not found:
        if not required:
            return None
        whose = f"of robot {robot!r} " if robot else ""
        raise UsageError(f"no daemon {whose}is running here (looked in {', '.join(map(str, folders))}); start one: s2r run PROFILE")
    if len(found) > 1:
        raise UsageError(f"several daemons run here: {', '.join(found)}; choose one with --robot NAME")
    return next(iter(found.values()))


class Presence(Protocol):
    """Whether the person who gave a command is still there. `left`: why not, or empty."""

    @property
    def left(self) -> str:
        """Why the person is not there any more, or empty."""

    def wait(self, sock: socket.socket) -> None:
        """Returns when the socket can be read, or the person left. Raises TimeoutError after the socket's own timeout."""


def call(path: Path, request: Request, on_progress: Callable[[Request], None] | None = None, presence: Presence | None = None) -> Request:
    """Sends a request and returns its final answer: `exit_code`, `text`, `data`. When the person leaves, the request is interrupted, and
    the answer says what became of it. Raises UsageError if nobody answers.
    """
    line = _line(request)
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as sock:
        sock.settimeout(FIRST_LINE_WITHIN_S)
        try:
            sock.connect(str(path))
            if (whose := _peer(sock)) not in (0, os.geteuid()) and not (os.geteuid() == 0 and _placed_by_root(path, whose)):
                hint = f"; if it is his daemon that you mean: sudo -u '#{whose}' s2r ..." if os.geteuid() == 0 else ""
                raise UsageError(f"{path}: whoever listens there is user {whose}, and no daemon of yours; nothing was said to him{hint}")
            sock.sendall(line)
            for answer in _answers(sock, presence):
                if "exit_code" in answer:
                    return answer
                if on_progress is not None and "accepted" not in answer:
                    on_progress(answer)
        except PermissionError:
            raise UsageError(f"{path}: belongs to another user's daemon; only its owner and root may talk to it") from None
        except TimeoutError:
            if presence is not None and presence.left:
                raise UsageError(f"{path}: the daemon does not answer; it stops the robot when it sees that this command is gone") from None
            raise UsageError(f"{path}: the daemon does not answer (waited {FIRST_LINE_WITHIN_S:.0f} s)") from None
        except OSError as error:
            raise UsageError(f"{path}: no daemon answers: {error.strerror or error}") from None
        except ValueError as error:
            raise UsageError(f"{path}: no daemon answers: {error}") from None
    raise UsageError(f"{path}: the daemon hung up before it answered; its log says why")


def _line(request: Request) -> bytes:
    """A request as it is sent. Raises UsageError for what the daemon would refuse."""
    try:
        line = json.dumps(request, ensure_ascii=False, allow_nan=False).encode() + b"\n"
    except UnicodeEncodeError:
        named = next((name for name, value in request.items() if _is_not_utf8(value)), "a field")
        raise UsageError(f"{request['verb']}: {named} is not UTF-8 text: {one_line(str(request.get(named, '')), 100)}; rename it") from None
    except ValueError as error:
        raise UsageError(f"{request['verb']}: {error}") from None
    if len(line) > REQUEST_MAX:
        raise UsageError(f"{request['verb']}: is longer than the {REQUEST_MAX} bytes that a request may have")
    return line


def _is_not_utf8(value: object) -> bool:
    return isinstance(value, str) and value.encode(errors="replace").decode() != value


def _answers(sock: socket.socket, presence: Presence | None) -> Iterator[Request]:
    """The daemon's lines, until it hangs up. Raises TimeoutError if none comes when it should."""
    buffer, interrupted = bytearray(), False
    while True:
        if presence is not None and not interrupted:
            presence.wait(sock)
            if presence.left:
                interrupted = True
                sock.settimeout(INTERRUPTED_WITHIN_S)
                sock.sendall(json.dumps({"verb": "interrupt", "text": presence.left}).encode() + b"\n")
        data = sock.recv(1 << 16)
        if not data:
            return
        buffer += data
        *lines, rest = buffer.split(b"\n")
        buffer = bytearray(rest)
        for line in lines:
            yield json.loads(line)
        if lines and not interrupted:
            sock.settimeout(None)  # it was heard; some requests take as long as a campaign


def _listening(path: Path) -> bool:
    """Whether somebody accepts connections there. One that we may not talk to counts: it is alive."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as sock:
        sock.settimeout(1.0)
        try:
            sock.connect(str(path))
        except PermissionError:
            return True
        except OSError:
            return False
    return True
