"""What a person is shown of files and peers: no control character of theirs reaches a terminal, a journal or a page."""

from __future__ import annotations

import json
import socket
import sys
import threading
from collections.abc import Callable
from pathlib import Path

import pytest
from daemon_rig import PROFILE

from s2r_runtime import messages as m
from s2r_runtime.cli import output
from s2r_runtime.cli.main import main
from s2r_runtime.files.printable import printable
from s2r_runtime.recording.writer import Writer

CLEAR, LINK, BELL, C1, BIDI = "\x1b[2J", "\x1b]8;;http://x\x1b\\", "\x07", "\x9b31m", "\u202egpj.exe"
HOSTILE = f"a{CLEAR}{LINK}{BELL}{C1}{BIDI}\u2066\ufeff\nforged line\r\x7f"
NAME = HOSTILE.replace("/", "_")
"""Of a file: all but a slash and a NUL may be in it."""


class Folder:
    """Files of every kind whose names and contents are hostile."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self.good = root / "good.toml"
        self.good.write_text(PROFILE.format(clock="lockstep", more=""))

    def put(self, suffix: str, text: str | bytes) -> str:
        path = self.root / f"{NAME}{suffix}"
        path.write_bytes(text if isinstance(text, bytes) else text.encode(errors="surrogateescape"))
        return str(path)

    def csv(self, header: str = "t,x,y,theta,v,w") -> str:
        return self.put(".csv", "\n".join([header, *(f"{k * 0.033:.3f},{k * 0.001:.4f},0,0,0.03,0" for k in range(60))]))

    def toml(self) -> str:
        return self.put(".toml", self.good.read_text() + f"[{json.dumps(HOSTILE)}]\n{json.dumps(HOSTILE)} = {json.dumps(HOSTILE)}\n")

    def described(self) -> str:
        return self.put(".toml", self.good.read_text().replace('name = "rig"', f'name = "rig"\ndescription = {json.dumps(HOSTILE)}'))

    def controller(self, text: str = "def control(x, theta, parameters):\n    return x\n") -> str:
        return self.put(".py", text)

    def log(self) -> str:
        path = self.root / f"{NAME}.mcap"
        writer = Writer(path, run=HOSTILE, metadata={"robot": HOSTILE}, attachments=[(HOSTILE, HOSTILE, b"x")])
        settings = core_settings()
        writer.write(m.Started(1, 1, settings, m.Memory(HOSTILE, m.MEMORY_SCHEMA, latched=(HOSTILE,), revoked={HOSTILE: HOSTILE})), 1)
        writer.write(m.LinkChanged(2, up=False, detail=HOSTILE), 2)
        writer.write(m.Requested(3, 1, "clear", 0, text=HOSTILE), 3)
        writer.write(m.Answer(3, 1, 1, HOSTILE), 3)
        writer.close()
        return str(path)


def core_settings() -> m.Settings:
    import msgspec
    from core_rig import SETTINGS

    return msgspec.structs.replace(SETTINGS, robot=HOSTILE, model_name=HOSTILE)


VERBS: dict[str, Callable[[Folder], list[str]]] = {
    "gap": lambda f: ["gap", f.csv(), "--profile", str(f.good)],
    "gap, a hostile column": lambda f: ["gap", f.csv(f"t,{CLEAR}x,y,theta,v,w"), "--profile", str(f.good)],
    "gap, a hostile profile": lambda f: ["gap", f.csv(), "--profile", f.toml()],
    "trace": lambda f: ["trace", f.csv(), "--profile", str(f.good), "--horizon", "0.5"],
    "trace, a hostile column": lambda f: ["trace", f.csv(f"t,x,y,theta,v,{BIDI}"), "--profile", str(f.good)],
    "topics": lambda f: ["topics", f.csv(f"t,x{CLEAR},y,theta{BELL},v,w")],
    "topics, a log": lambda f: ["topics", f.log()],
    "profile check": lambda f: ["profile", "check", f.toml()],
    "profile check, a description": lambda f: ["profile", "check", f.described()],
    "profile check, everything": lambda f: ["profile", "check", f.described(), "--all"],
    "verify": lambda f: ["verify", f.controller(f"# {CLEAR}\nx = {BELL}"), "--profile", str(f.good), "--radius", "0.01", "-n", "5"],
    "verify, a controller that raises": lambda f: [
        "verify",
        f.controller(f"def control(x, theta, parameters):\n    raise ValueError({HOSTILE!r})\n"),
        "--profile",
        str(f.good),
        "--radius",
        "0.01",
        "-n",
        "5",
    ],
    "certify": lambda f: ["certify", f.controller(), "--profile", str(f.good), "--recording", f.csv(), "-o", f.put(".cert", "")],
    "synthesize": lambda f: ["synthesize", f.controller(f"PARAMETERS = {{{CLEAR!r}: 1}}\n"), "--profile", str(f.good)],
    "trials": lambda f: ["trials", f.log(), "--profile", str(f.good), "--controller", f.controller()],
    "audit": lambda f: ["audit", f.log()],
    "report": lambda f: ["report", f.log(), "-o", str(f.root / "page.html")],
    "log info": lambda f: ["log", "info", f.log()],
    "log recover": lambda f: ["log", "recover", f.log(), "-o", str(f.root / "out.mcap")],
    "deploy": lambda f: ["deploy", f.controller(), "--socket", str(f.root / "none.sock")],
    "adopt": lambda f: ["adopt", f.toml()],
    "keys list": lambda f: ["keys", "list", str(Path(f.put(".pub", HOSTILE)).parent)],
    "keys new": lambda f: ["keys", "new", f.put(".pem", HOSTILE)],
    "plugin show": lambda f: ["plugin", "show", HOSTILE],
    "a verb": lambda f: [HOSTILE],
}


@pytest.mark.parametrize("name", VERBS)
def test_no_verb_prints_what_a_file_would_have_a_terminal_do(name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    try:
        code = main(VERBS[name](Folder(tmp_path)))
    except SystemExit as end:
        code = int(end.code or 0)
    said = capsys.readouterr()
    assert code in (0, 1, 2, 3, 78), said.err
    assert_printable(said.out)
    assert_printable(said.err)
    assert not any(line.startswith("forged line") for line in (said.out + said.err).splitlines())
    if (page := tmp_path / "page.html").exists():
        assert_printable(page.read_text())


def assert_printable(text: str) -> None:
    strange = {c for line in text.split("\n") for c in line if not c.isprintable()}
    assert strange == set(), ascii(text)[:2000]


def test_a_daemon_that_is_none_cannot_steer_the_terminal_of_who_asks_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "r.sock"
    answer = {"exit_code": 0, "text": HOSTILE, "data": {"gate": HOSTILE, "reason": HOSTILE, "controller": {HOSTILE: [HOSTILE]}}}
    with socket.socket(socket.AF_UNIX) as server:
        server.bind(str(path))
        server.listen()

        def serve() -> None:
            for _ in range(2):
                peer, _ = server.accept()
                with peer:
                    peer.recv(1 << 16)
                    peer.sendall(json.dumps({"text": HOSTILE}).encode() + b"\n" + json.dumps(answer).encode() + b"\n")

        thread = threading.Thread(target=serve)
        thread.start()
        for verb in ("status", "stop"):
            assert main([verb, "--socket", str(path)]) == 0
        thread.join()
    said = capsys.readouterr()
    assert_printable(said.out)
    assert_printable(said.err)


def test_own_styles_pass_and_no_others(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.delenv("NO_COLOR", raising=False)
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True, raising=False)
    output.out(output.styled(f"good {CLEAR}", "green") + "\x1b[31mred")
    assert capsys.readouterr().out == "\x1b[32mgood \\x1b[2J\x1b[0m\\x1b[31mred\n"


@pytest.mark.parametrize("text", ["plain", "ä·→█ 5 %", "", HOSTILE, "\ud800", "\U000e0041", "\t"])
def test_what_is_printable_stays_and_all_else_becomes_its_escape(text: str) -> None:
    shown = printable(text)
    assert shown.isprintable()
    assert (shown == text) == text.isprintable()
