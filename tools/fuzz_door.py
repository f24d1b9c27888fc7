"""Feeds the daemon's door, and whatever reads a file that a person hands over, with what nobody should send.

    python tools/fuzz_door.py [--cases N] [--live N] [--seed S] [--quick] [--json]

Requests go through the function that decodes them in the gate's process, and files (profiles, models, controllers, certificates,
recordings, logs) through the readers that a worker or the command line uses: an error that is none of the person's, one of several lines
or with control characters, or, at the door, more than 20 ms of processor time, is a failure. Then a running daemon is asked over its
socket while a controller drives: it must answer every request, and hold its loop for no longer than 20 ms; its log must be whole.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import random
import socket
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import msgspec

ROOT = Path(__file__).parent.parent
sys.path.insert(0, str(ROOT / "tests" / "rigs"))

import daemon_rig  # noqa: E402

from s2r_runtime.controllers import file as controllers  # noqa: E402
from s2r_runtime.daemon import door, jobs  # noqa: E402
from s2r_runtime.daemon.control import REQUEST_MAX  # noqa: E402
from s2r_runtime.errors import S2RError  # noqa: E402
from s2r_runtime.messages import Requested  # noqa: E402
from s2r_runtime.models.composed import compose  # noqa: E402
from s2r_runtime.modelspec import (  # noqa: E402
    ModelSpec,
    load_model,
    parse_model,
)
from s2r_runtime.profile import check_model, load_profile  # noqa: E402
from s2r_runtime.recording.writer import Writer, read  # noqa: E402
from s2r_runtime.recordings.loading import load_transitions  # noqa: E402
from s2r_runtime.trust import certificate, keys  # noqa: E402

HELD_MAX_S = 0.02
"""Of processor time: what the gate's loop may spend on one request."""
BASE = (
    {"verb": "status"},
    {"verb": "stop"},
    {"verb": "clear", "text": "emergency_stop"},
    {"verb": "revoke", "text": "sha256:00"},
    {"verb": "permit", "duration_s": 1.0},
    {"verb": "sample", "count": 3, "detached": True},
    {"verb": "deploy", "path": "c.py", "seed": 7, "first": 2, "count": 1},
    {"verb": "trace", "text": "campaign"},
    {"verb": "deploy", "path": "/nowhere/c.py", "parameters": {"gain": 1.0, "name": "a", "on": True}, "certificate": "{}"},
    {"verb": "adopt", "text": "[model]\nname = 'unicycle'\ndt = 0.033\n", "base": "/nowhere"},
    {"verb": "excite", "path": "/nowhere/u.csv"},
)
DEEP = "[" * 100_000 + "]" * 100_000
TEXTS = (
    "",
    "\0",
    "\x1b[2J",
    "\x1b]8;;http://x\x07",
    "\x9b31m",
    "\u202eevil",
    "\ufeff",
    "a\nb",
    "é" * 300,
    "x" * 100_000,
    "../" * 2000,
    "%s%n",
    "-0",
)
JSONS = (
    b'"\\ud800"', b'"\\udcff"', b'"\\ud800\\u0041"', b'"\xff"', b'"\\u0000"', b"NaN", b"Infinity", b"-1e999", b"1e999",
    b"9" * 10_000,    b"-" + b"9" * 5000, b"0." + b"0" * 5000 + b"1", b"null", b"true", b"[]", b"{}", b"[[[[]]]]", DEEP.encode(),
    b'{"a":' * 50_000, b'"' + b"\\u0041" * 150_000 + b'"',
    b"{" + b",".join(b'"%d":1' % i for i in range(50_000)) + b"}",
)  # fmt: skip
TOMLS = (
    "delay = nan", "delay = inf", "delay = -inf", "x = " + "9" * 10_000, "x = " + "9" * 400, "x = 1e999", "a = " + DEEP,
    ".".join("a" * 30_000) + " = 1",
    "[" + ".".join("b" * 5000) + "]", 'x = "\\u0000"', 'x = "\\ud800"', "x = '\x1b'", "[[model.effects]]", "[model]", "= 1",
    "x = 1979-05-27", '"" = 1', "a = {" * 3000,
)  # fmt: skip
CODES = (
    "PARAMETERS = " + "(" * 300 + ")" * 300,
    "PARAMETERS = {'a': " + "9" * 5000 + "}",
    "PARAMETERS = {'a': 1e999}",
    "PARAMETERS = {'\\udcff': 1}",
    "PARAMETERS = {'a': '\\ud800'}",
    "PARAMETERS = {'a': " + "[" * 90 + "]" * 90 + "}",
    "import os.path as\n",
    "\0",
    "x = " + "-" * 100_000 + "1",
    "x = " + "+".join("1" * 20_000),
    "from . import x",
    "import numpy.nothing",
    "# -*- coding: utf-7 -*-",
    "def control(x): pass",
)
CELLS = (
    "nan",
    "inf",
    "-1e999",
    "9" * 5000,
    "",
    '"',
    "\0",
    "1,2",
    "0x10",
    "1_000",
    "\x1b[2J",
    "é",
    "1e-400",
    "\udcff",
    "2026-01-01",
    "\n\n",
)


class Found(NamedTuple):
    """wrong: what did not hold. slowest_s: processor time at the door."""

    cases: int
    refused: int
    wrong: list[str]
    slowest_s: float


# ---------------------------------------------------------------- cases


def mutated(rng: random.Random, data: bytes) -> bytes:
    """Cut, flipped, doubled, with something strange in it."""
    for _ in range(rng.randint(1, 4)):
        at = rng.randrange(len(data) + 1)
        match rng.randrange(5):
            case 0:
                data = data[:at]
            case 1:
                data = data[:at] + bytes([rng.randrange(256)]) + data[at + 1 :]
            case 2:
                data = data[:at] + data[max(0, at - 40) : at] * rng.randint(1, 30) + data[at:]
            case 3:
                data = data[:at] + rng.choice([c.encode(errors="surrogateescape") for c in TEXTS if len(c) < 1000]) + data[at:]
            case _:
                data = data[:at] + bytes(rng.randrange(256) for _ in range(rng.randint(1, 8))) + data[at:]
    return data


def request_line(rng: random.Random) -> bytes:
    """A request: a good one of which a field is strange, or the line."""
    request: dict[str, Any] = dict(rng.choice(BASE))
    if rng.random() < 0.4:
        return mutated(rng, json.dumps(request).encode()).replace(b"\n", b" ")
    field = rng.choice(
        [
            *request,
            "verb",
            "path",
            "text",
            "base",
            "certificate",
            "parameters",
            "duration_s",
            "count",
            "seed",
            "first",
            "detached",
            rng.choice(TEXTS),
        ]
    )
    request[field] = "@@"
    value = rng.choice(JSONS) if rng.random() < 0.7 else json.dumps(rng.choice((*TEXTS, *TOMLS))).encode()
    return json.dumps(request).encode().replace(b'"@@"', value, 1)[:REQUEST_MAX]


def toml_text(rng: random.Random, good: str) -> str:
    """A profile or model: with lines put in, or damaged."""
    if rng.random() < 0.5:
        return mutated(rng, good.encode()).decode(errors="surrogateescape")
    lines = good.splitlines()
    for _ in range(rng.randint(1, 3)):
        at = rng.randrange(len(lines) + 1)
        if rng.random() < 0.5 and at < len(lines) and "=" in lines[at]:
            strange = rng.choice(TOMLS)
            lines[at] = lines[at].split("=")[0] + "= " + (strange.split("=", 1)[1] if "=" in strange else "[]")
        else:
            lines.insert(at, rng.choice(TOMLS))
    return "\n".join(lines)


# ---------------------------------------------------------------- in this process


class Bench:
    """Good files of every kind, and the readers of each. `readers`: name -> one case."""

    def __init__(self, folder: Path, rng: random.Random) -> None:
        self.folder, self.rng = folder, rng
        rig = daemon_rig.Rig(folder, clock="realtime")
        self.profile_text, self.profile = rig.profile.read_text(), load_profile(rig.profile)
        self.spec = self.profile.model
        self.model_text = self.profile_text[self.profile_text.index("[model]") : self.profile_text.index("[region]")]
        self.controller_text = "PARAMETERS = {'gain': 1.5}\nimport numpy as np\n\n\ndef control(x, theta, parameters):\n    return x\n"
        keys.new(folder / "key.pem")
        controller = folder / "c.py"
        controller.write_text(self.controller_text)
        signed = daemon_rig.made_up_certificate(rig.profile, folder / "key.pem", controller, radius=0.01, verified=0.02, epoch=1)
        self.certificate, self.keys = signed.encode(), (keys.public_bytes(keys.load(folder / "key.pem")),)
        self.table = ["t,x,y,theta,v,w,segment"] + [f"{k * 0.033:.4f},{k * 0.001:.4f},0,0,0.03,0,{k // 4}" for k in range(40)]
        log = folder / "log.mcap"
        writer = Writer(log, run="fuzz")
        for k in range(60):
            writer.write(Requested(k, k, "clear", 0, text=f"r{k}"), k)
        writer.close()
        self.log = log.read_bytes()
        self.plain = compose(ModelSpec("unicycle", 0.033))
        self.readers: dict[str, Callable[[], object]] = {
            "profile": self._profile_file,
            "model": self._model_file,
            "model in a request": self._model_in_request,
            "controller": self._controller,
            "parameters": self._parameters,
            "certificate": self._signed,
            "recording": self._recording,
            "log": self._own_log,
        }

    def _put(self, name: str, data: bytes | str) -> Path:
        path = self.folder / name
        path.write_bytes(data if isinstance(data, bytes) else data.encode(errors="surrogateescape"))
        return path

    def _profile_file(self) -> object:
        profile = load_profile(self._put("p.toml", toml_text(self.rng, self.profile_text)))
        return msgspec.json.encode(profile), check_model(profile, "p")

    def _model_file(self) -> object:
        return msgspec.json.encode(load_model(self._put("m.toml", toml_text(self.rng, self.model_text))))

    def _model_in_request(self) -> object:
        text = toml_text(self.rng, self.model_text)
        raw = json.dumps(text).encode() if self.rng.random() < 0.8 else self.rng.choice(JSONS)
        spec = parse_model(jobs.opened(msgspec.Raw(raw), str, "adopt"), str(self.folder), "adopt")
        return msgspec.json.encode(spec), compose(spec, "adopt")

    def _controller(self) -> object:
        lines = self.controller_text.splitlines()
        strange = self.rng.choice(CODES)
        text = self.controller_text.encode()
        if self.rng.random() < 0.5:
            text = mutated(self.rng, text)
        else:
            lines[0 if strange.startswith("PARAM") else self.rng.randrange(4)] = strange
            text = "\n".join(lines).encode(errors="surrogateescape")
        return msgspec.json.encode(controllers.load(self._put("c.py", text)))

    def _parameters(self) -> object:
        raw = msgspec.Raw(self.rng.choice([*JSONS, b'{"gain":' + self.rng.choice(JSONS) + b"}"]))
        given = jobs.opened(raw, dict[str, float | str | bool], "parameters")
        return controllers.load(self._put("c.py", self.controller_text), given)

    def _signed(self) -> object:
        data = mutated(self.rng, self.certificate)
        if self.rng.random() < 0.3:
            at = self.certificate.index(b":", self.rng.randrange(len(self.certificate) // 2)) + 1
            data = self.certificate[:at] + self.rng.choice(JSONS) + self.certificate[at:]
        return certificate.load(data, self.keys, 1, "c"), certificate.signer(data)

    def _recording(self) -> object:
        rows = [line.split(",") for line in self.table]
        for _ in range(self.rng.randint(1, 4)):
            row = self.rng.choice(rows)
            row[self.rng.randrange(len(row))] = self.rng.choice(CELLS)
        data = "\n".join(map(",".join, rows)).encode(errors="surrogateescape")
        return load_transitions(self._put("r.csv", mutated(self.rng, data) if self.rng.random() < 0.3 else data), self.plain)

    def _own_log(self) -> object:
        return [entry.message for entry in read(self._put("l.mcap", mutated(self.rng, self.log)))]


def at_the_door(rng: random.Random, cases: int) -> Found:
    """Requests, decoded as in the gate's process."""
    refused, wrong, slowest = 0, [], 0.0
    for number in range(cases):
        line = request_line(rng)
        begun = time.thread_time()
        try:
            request = door.decode_request(line)
            msgspec.json.encode(
                Requested(0, 1, "clear", 0, text=request.text or request.path, duration_s=request.duration_s, count=request.count)
            )
        except S2RError as error:
            refused += 1
            wrong += [f"request {number}: {one}" for one in badly_said(error)]
        except Exception as error:  # noqa: BLE001 - what this looks for
            wrong.append(f"request {number}: {type(error).__name__}: {error!s:.200} from {line[:100]!r}")
        slowest = max(slowest, time.thread_time() - begun)
    if slowest > HELD_MAX_S:
        wrong.append(f"a request took {slowest * 1e3:.1f} ms")
    return Found(cases, refused, wrong, slowest)


def badly_said(error: S2RError) -> list[str]:
    """What is wrong with the words of an error."""
    said = str(error)
    return [f"not one printable line: {said!r:.300}"] if any(not c.isprintable() for c in said) else []


def of_files(rng: random.Random, cases: int) -> dict[str, Found]:
    """Files of every kind, read as a worker or the command line reads them."""
    found = {}
    with tempfile.TemporaryDirectory() as folder:
        bench = Bench(Path(folder), rng)
        for name, reader in bench.readers.items():
            refused, wrong, slowest = 0, [], 0.0
            for number in range(cases):
                begun = time.thread_time()
                try:
                    reader()
                except S2RError:
                    refused += 1
                except Exception as error:  # noqa: BLE001 - what this looks for
                    wrong.append(f"{name} {number}: {type(error).__name__}: {error!s:.300}")
                slowest = max(slowest, time.thread_time() - begun)
            found[name] = Found(cases, refused, wrong, slowest)
    return found


# ---------------------------------------------------------------- a running daemon


def live(rng: random.Random, cases: int) -> Found:
    """A daemon that is asked over its socket while a controller drives."""
    answers: Counter[int] = Counter()
    wrong: list[str] = []
    with tempfile.TemporaryDirectory() as folder:
        rig = daemon_rig.Rig(Path(folder), clock="realtime")
        try:
            rig.start_robot()
            rig.start("--held", str(Path(folder) / "held"))
            assert rig.deploy()["exit_code"] == 0
            rig.until_status(gate="open")
            for number in range(cases):
                line = request_line(rng)
                code = _asked(rig.socket, line)
                answers[code] += 1
                if code < 0:
                    wrong.append(f"live {number}: no answer to {line[:100]!r}")
                if rig.daemon is None or rig.daemon.poll() is not None:
                    wrong.append(f"live {number}: the daemon ended: {rig.said()[-1000:]}")
                    break
            if (recorder := rig.status()["recorder"]) != "ok":
                wrong.append(f"the log ended: {recorder}")
            if code := rig.stop():
                wrong.append(f"exit code {code}")
            held = float(json.loads((Path(folder) / "held").read_text())["client"])
            if held > HELD_MAX_S:
                wrong.append(f"the loop was held for {held * 1e3:.1f} ms")
            audited = json.loads(rig.s2r("audit", *map(str, rig.log_files()), "--key", str(rig.state / "key.pub"), "--json").stdout)
            if not audited["ok"]:
                wrong.append(f"the audit finds: {audited['first_difference']}")
        finally:
            rig.close()
    return Found(cases, sum(n for code, n in answers.items() if code), wrong, held)


def _asked(path: Path, line: bytes) -> int:
    """Exit code of the answer; -1 if there is none. What would drive is withdrawn by hanging up after a moment."""
    with socket.socket(socket.AF_UNIX) as sock, contextlib.suppress(OSError):
        sock.settimeout(60.0)
        sock.connect(str(path))
        sock.sendall(line + b"\n")
        data = b""
        while chunk := sock.recv(1 << 16):
            data += chunk
        for answer in data.splitlines():
            plain = json.loads(answer)
            if "exit_code" in plain:
                return int(plain["exit_code"])
    return -1


def main() -> int:
    """0 if nothing did what it may not."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", type=int, default=100_000, help="in this process, a half of them requests")
    parser.add_argument("--live", type=int, default=3000, help="to a running daemon")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    cases, asked = (4000, 200) if options.quick else (options.cases, options.live)
    rng, begun = random.Random(options.seed), time.monotonic()
    found = {"request": at_the_door(rng, cases // 2)}
    found |= of_files(rng, cases // 16)
    if asked:
        found["live"] = live(rng, asked)
    wrong = [line for one in found.values() for line in one.wrong]
    if options.json:
        print(json.dumps({name: one._asdict() for name, one in found.items()}, indent=1))
    else:
        for name, one in found.items():
            took = f"slowest {one.slowest_s * 1e3:.1f} ms of processor time"
            print(f"{name:18s} {one.cases:7d} cases, {one.refused:7d} refused, {len(one.wrong)} wrong, {took}")
        print("\n".join(wrong[:50]))
        print(f"{sum(one.cases for one in found.values())} cases, {len(wrong)} wrong; {time.monotonic() - begun:.0f} s")
    return 1 if wrong else 0


if __name__ == "__main__":
    raise SystemExit(main())
