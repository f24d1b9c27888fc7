"""`s2r live --foxglove`: foreign clients read every channel; bad ones cost nobody anything; pages of elsewhere do not get in."""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from audit_bench import Bench
from daemon_rig import PROGRAM, Rig
from live_clients import noise, raw, stall

from s2r_runtime.live.origins import Door

websockets = pytest.importorskip("websockets")
pytest.importorskip("foxglove")

from websockets.asyncio.client import connect  # noqa: E402 - only where it is installed
from websockets.exceptions import ConnectionClosed, InvalidMessage, InvalidStatus  # noqa: E402

ALL = {"/state", "/input", "/residual", "/watch", "/gate", "/pose", "/tf", "/scene", "/events"}
NODE = ("@mcap/core@2.2.2", "@foxglove/schemas@2.1.0", "@foxglove/ws-protocol@0.8.0", "ajv@8", "ws@8", "fzstd@0.1.1")
SDK = "foxglove.sdk.v1"


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("log")
    return Bench(folder).sample().drive(900).stop().write(folder / "a.mcap")


class Served:
    """`s2r live --foxglove` as a process. url: where it listens."""

    def __init__(self, *argv: str, environment: dict[str, str] | None = None, program: tuple[str, ...] = ("-m", "s2r_runtime")) -> None:
        self.process = subprocess.Popen(
            [sys.executable, *program, "live", "--foxglove", "0", *argv], stderr=subprocess.PIPE, text=True, env=environment
        )
        assert self.process.stderr is not None
        line = self.process.stderr.readline()
        assert "ws://" in line, line
        self.url = line.split(" at ")[1].split()[0]
        self.port = int(self.url.rpartition(":")[2])

    def memory_mb(self) -> float:
        pages = int(Path(f"/proc/{self.process.pid}/statm").read_text().split()[1])
        return pages * os.sysconf("SC_PAGE_SIZE") / 1e6

    def close(self) -> None:
        if self.process.poll() is None:
            self.process.send_signal(signal.SIGINT)
            code = self.process.wait(20)
            assert code == 0, code
        assert self.process.stderr is not None
        self.process.stderr.close()


@pytest.fixture
def served(log: Path) -> Iterator[Served]:
    """Of a finished log, slowly."""
    one = Served(str(log), "--speed", "2")
    yield one
    one.close()


async def read_all(url: str, seconds: float, origin: str | None = None) -> dict[str, list[dict[str, Any]]]:
    """What a foreign client gets that subscribes to every channel once it is advertised."""
    found: dict[str, list[dict[str, Any]]] = {}
    topics: dict[int, str] = {}
    async with connect(url, subprotocols=[SDK], origin=origin, max_size=None) as client:
        until = time.monotonic() + seconds
        while (left := until - time.monotonic()) > 0.0:
            try:
                message = await asyncio.wait_for(client.recv(), left)
            except TimeoutError:
                break
            if isinstance(message, bytes):
                if message[0] == 1:
                    found.setdefault(topics[int.from_bytes(message[1:5], "little")], []).append(json.loads(message[13:]))
                continue
            said = json.loads(message)
            for channel in said.get("channels", []) if said["op"] == "advertise" else []:
                assert (channel["encoding"], channel["schemaEncoding"]) == ("json", "jsonschema")
                assert json.loads(channel["schema"])["type"] == "object"
                topics[channel["id"]] = channel["topic"]
                await client.send(json.dumps({"op": "subscribe", "subscriptions": [{"id": channel["id"], "channelId": channel["id"]}]}))
    return found


def test_a_foreign_client_reads_every_channel(served: Served) -> None:
    found = asyncio.run(read_all(served.url, 8.0))
    assert set(found) == ALL
    assert set(found["/state"][0]) == {"x", "y", "theta"}
    assert {one["id"] for one in found["/scene"][0]["entities"]} >= {"region", "geofence"}


@pytest.mark.parametrize(
    ("origin", "enters"),
    [
        (None, True),
        ("http://localhost:8080", True),
        ("http://127.0.0.1:3000", True),
        ("https://app.foxglove.dev", True),
        ("file://", True),
        ("https://evil.example", False),
        ("https://app.foxglove.dev.evil.example", False),
        ("http://localhost.evil.example", False),
        ("null", False),
    ],
)
def test_a_page_of_elsewhere_does_not_get_in(served: Served, origin: str | None, enters: bool) -> None:
    async def one() -> None:
        async with connect(served.url, subprotocols=[SDK], origin=origin) as client:
            assert json.loads(await client.recv())["op"] == "serverInfo"

    if enters:
        asyncio.run(one())
    else:
        with pytest.raises(InvalidStatus, match="403"):
            asyncio.run(one())


def test_an_origin_that_is_permitted_gets_in(log: Path) -> None:
    served = Served(str(log), "--origin", "https://lichtblick.example/")
    try:
        assert asyncio.run(read_all(served.url, 1.0, "https://lichtblick.example")) is not None
        with pytest.raises(InvalidStatus, match="403"):
            asyncio.run(read_all(served.url, 1.0, "https://other.example"))
    finally:
        served.close()


def test_the_name_of_the_protocol_may_be_the_earlier_one(served: Served) -> None:
    async def one() -> str | None:
        async with connect(served.url, subprotocols=["foxglove.websocket.v1"]) as client:
            assert json.loads(await client.recv())["op"] == "serverInfo"
            return client.subprotocol

    assert asyncio.run(one()) == "foxglove.websocket.v1"


def test_garbage_and_ten_thousand_subscriptions_and_stalled_clients_harm_nobody(served: Served) -> None:
    async def hostile() -> None:
        for some in noise():
            with raw(served.port) as connection, contextlib.suppress(OSError):
                connection.sendall(some)
                connection.recv(100)
        for garbage in ("{", "[]", '{"op":"subscribe","subscriptions":"x"}', '{"op":"nothing"}', "\x00" * 1000, b"\xff" * 1000, b""):
            with contextlib.suppress(ConnectionClosed, InvalidMessage):
                async with connect(served.url, subprotocols=[SDK]) as client:
                    await client.send(garbage)
                    await asyncio.sleep(0.05)
        async with connect(served.url, subprotocols=[SDK], max_size=None) as client:
            with contextlib.suppress(ConnectionClosed):
                for first in range(0, 10_000, 100):
                    many = [{"id": k, "channelId": 1 + k % 12} for k in range(first, first + 100)]
                    await client.send(json.dumps({"op": "subscribe", "subscriptions": many}))
                await asyncio.sleep(1.0)

    before = served.memory_mb()
    stalled = [stall(served.port) for _ in range(10)]
    asyncio.run(hostile())
    found = asyncio.run(read_all(served.url, 4.0))
    assert len(found["/watch"]) > 20
    assert served.process.poll() is None
    assert served.memory_mb() - before < 60.0
    for connection in stalled:
        connection.close()


def test_a_port_that_is_taken_is_one_line(log: Path, served: Served) -> None:
    argv = [sys.executable, "-m", "s2r_runtime", "live", str(log), "--foxglove", str(served.port)]
    done = subprocess.run(argv, capture_output=True, text=True, check=False, timeout=60)
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1
    assert f"127.0.0.1:{served.port}: cannot be listened on: " in done.stderr


def test_no_more_than_32_clients_at_a_time() -> None:
    with socket.create_server(("127.0.0.1", 0)) as behind:
        door = Door("127.0.0.1", 0, behind.getsockname())
        crowd = [raw(door.port) for _ in range(40)]
        try:
            for one in crowd:
                one.sendall(b"GET / HTTP/1.1\r\nUpgrade: websocket\r\n\r\n")
            answers = []
            time.sleep(1.0)
            for one in crowd:
                one.settimeout(0.05)
                with contextlib.suppress(TimeoutError):
                    answers.append(one.recv(20))
            assert answers == [b"HTTP/1.1 503 Service"[:20]] * 8
        finally:
            for one in crowd:
                one.close()
            door.close()
            door.close()


def test_a_log_that_was_cut_is_replayed_as_far_as_it_goes(log: Path, tmp_path: Path) -> None:
    path = tmp_path / "cut.mcap"
    path.write_bytes(log.read_bytes()[:-40_000])
    served = Served(str(path), "--speed", "10")
    try:
        assert "/state" in asyncio.run(read_all(served.url, 3.0))
    finally:
        served.close()


@pytest.mark.slow
def test_a_daemon_is_followed_over_its_death_into_the_next_log(tmp_path: Path) -> None:
    rig = Rig(tmp_path, clock="realtime")
    served = None
    try:
        rig.start_robot()
        rig.start()
        rig.until(lambda: rig.status()["observation"])
        served = Served("--socket", str(rig.socket), program=(str(PROGRAM), "s2r"), environment=rig.environment)
        first = asyncio.run(read_all(served.url, 3.0))
        assert len(first["/state"]) > 30
        rig.kill()
        rig.start()
        rig.until(lambda: rig.status()["observation"])
        time.sleep(4.0)
        again = asyncio.run(read_all(served.url, 3.0))
        assert len(again["/state"]) > 30
        assert time.time() - again["/pose"][-1]["timestamp"]["sec"] < 5.0
        assert rig.stop() == 0
    finally:
        if served is not None:
            served.close()
        rig.close()


# ---------------------------------------------------------------- Foxglove's own code


@pytest.fixture(scope="module")
def node(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Foxglove's packages, where there is node and a registry."""
    npm = shutil.which("npm")
    if npm is None or shutil.which("node") is None:
        pytest.skip("no node on this machine")
    folder = tmp_path_factory.mktemp("node")
    (folder / "package.json").write_text("{}")
    argv = [npm, "install", "--no-audit", "--no-fund", "--ignore-scripts", "--prefix", str(folder), *NODE]
    if subprocess.run(argv, capture_output=True, check=False, timeout=300).returncode != 0:
        pytest.skip("the npm registry has not all that this needs, or is not reached")
    shutil.copy(Path(__file__).parent / "rigs" / "foreign_viewers.cjs", folder)
    return folder


def viewed(folder: Path, *argv: str) -> dict[str, int]:
    done = subprocess.run(["node", "foreign_viewers.cjs", *argv], cwd=folder, capture_output=True, text=True, check=False, timeout=120)
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    assert found["wrong"] == [], found
    return dict(found["counts"])


@pytest.mark.slow
def test_foxgloves_reader_and_schemas_take_every_message_of_an_export(node: Path, log: Path, tmp_path: Path) -> None:
    out = tmp_path / "out.mcap"
    argv = [sys.executable, "-m", "s2r_runtime", "export", str(log), "-o", str(out), "--json"]
    done = subprocess.run(argv, capture_output=True, text=True, check=True)
    assert viewed(node, "file", str(out)) == json.loads(done.stdout)["channels"]


@pytest.mark.slow
def test_foxgloves_client_takes_every_message_of_the_stream(node: Path, served: Served) -> None:
    assert set(viewed(node, "live", served.url, "6")) == ALL
