"""The profile with mutual TLS: who has no certificate of the site gets no link, and who has another name gets nothing through it."""

from __future__ import annotations

import time
import tomllib
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest

zenoh = pytest.importorskip("zenoh")
from s2r_zenoh.testing import INPUTS, STATES, free_endpoint, session  # noqa: E402 - only where Zenoh is
from s2r_zenoh.transport import ZenohTransport  # noqa: E402

from s2r_runtime import tls  # noqa: E402
from s2r_runtime.cli.main import main  # noqa: E402
from s2r_runtime.errors import ConfigError, UsageError  # noqa: E402
from s2r_runtime.messages import Command  # noqa: E402

PROFILE = Path(__file__).parent.parent / "profiles" / "robotarium-mtls.toml"
PREFIX = "s2r/robot"
OBSERVATION = b'{"seq":%d,"stamp_ns":%d,"state":{"x":0.1,"y":0.2,"theta":0.3}}'
STOP = b'{"kind":"emergency_stop","detail":"planted"}'
WITHIN_S = 20.0


class Site:
    """The transport of the profile, on loopback, with certificates of its own."""

    def __init__(self, folder: Path, stack: ExitStack, **changed: Any) -> None:
        tls.make(folder / "site", ["runtime", "robot", "operator", "visitor"], ["127.0.0.1"])
        tls.make(folder / "other", ["robot", "operator"], ["127.0.0.1"])
        self.folder, self._stack = folder, stack
        options = tomllib.loads(PROFILE.read_text())["transport"]
        assert options.pop("name") == "zenoh"
        self.robot_side, self.other_side = (free_endpoint().replace("tcp/", "tls/") for _ in range(2))
        options |= {"robot_listen": self.robot_side, "controller_listen": self.other_side}
        options |= {name: value.replace("/etc/s2r/tls", str(folder / "site")) for name, value in options.items() if name.startswith("tls_")}
        self.transport = ZenohTransport(options | changed, STATES, INPUTS)
        stack.callback(self.transport.close)
        self.transport.open()
        self.number = 0

    def link(self, who: str, endpoint: str, mode: str = "peer") -> Any:
        """A session of somebody with the certificate `who` (folder/name), or without one."""
        settings: dict[str, Any] = {}
        if who:
            base = str(self.folder / who)
            settings = {
                "root_ca_certificate": str(self.folder / "site" / "site.pem"),
                "connect_certificate": f"{base}.pem",
                "connect_private_key": f"{base}.key",
                "enable_mtls": True,
            }
            settings = {"transport__link__tls": settings}
        if mode == "client":
            settings["connect__timeout_ms"] = 3000
        return self._stack.enter_context(session(mode, connect=endpoint, **settings))

    def command(self) -> None:
        """What the runtime says to the robot."""
        self.number += 1
        self.transport.send(self.transport.encode(Command(self.number, self.number, "recovery", (0.0, 0.0), 1, 10**9)))

    def frames(self, seconds: float, act: Callable[[], None], until: Callable[[list[str]], bool] = lambda _: False) -> list[str]:
        """Channels of what the runtime receives while this is done again and again."""
        found: list[str] = []
        limit = time.monotonic() + seconds
        while time.monotonic() < limit and not until(found):
            act()
            self.transport.poll(time.monotonic_ns())
            found += [frame.channel for frame in self.transport.receive()]
            time.sleep(0.02)
        return found


def hear(opened: Any, into: list[str]) -> None:
    """Everything that others say, on every key of interest, by its own name and by wildcards."""
    for key in ("**", "s2r/**", *(f"{PREFIX}/{name}" for name in ("command", "observation", "proposal", "override"))):
        opened.declare_subscriber(key, lambda sample: into.append(str(sample.key_expr)), allowed_origin=zenoh.Locality.REMOTE)


@pytest.fixture
def stack() -> Iterator[ExitStack]:
    with ExitStack() as opened:
        yield opened


def observation(site: Site) -> bytes:
    site.number += 1
    return OBSERVATION % (site.number, site.number)


def test_the_named_robot_and_operator_get_through_and_nobody_else_does_in_either_direction(tmp_path: Path, stack: ExitStack) -> None:
    site = Site(tmp_path, stack)
    heard: dict[str, list[str]] = {}

    def listen(name: str, who: str, endpoint: str, mode: str = "peer") -> Any:
        opened, heard[name] = site.link(who, endpoint, mode), []
        hear(opened, heard[name])
        return opened

    wrong = {
        "visitor": listen("visitor", "site/visitor", site.robot_side),
        "operator on the robot's side": listen("operator on the robot's side", "site/operator", site.robot_side),
        "another site's robot": listen("another site's robot", "other/robot", site.robot_side),
        "no certificate": listen("no certificate", "", site.robot_side),
        "plain TCP": listen("plain TCP", "", site.robot_side.replace("tls/", "tcp/")),
        "visitor among controllers": listen("visitor among controllers", "site/visitor", site.other_side),
        "robot among controllers": listen("robot among controllers", "site/robot", site.other_side),
    }
    operator = listen("operator", "site/operator", site.other_side)
    keys = [f"{PREFIX}/{name}" for name in ("command", "observation", "override", "log", "proposal")] + [f"{PREFIX}/*", "s2r/**", "**"]

    def attack() -> None:
        for number, somebody in enumerate(wrong.values()):
            for key in keys:
                if "proposal" not in key or number < 5:
                    somebody.put(key, STOP)
            somebody.put(f"{PREFIX}/observation", observation(site))
        for key in keys:
            if "proposal" not in key:
                operator.put(key, STOP)
        operator.put(f"{PREFIX}/observation", observation(site))
        site.command()

    robot = listen("robot", "site/robot", site.robot_side)

    def speak() -> None:
        robot.put(f"{PREFIX}/observation", observation(site))
        site.command()

    def both_ways(found: list[str]) -> bool:
        return "observation" in found and f"{PREFIX}/command" in heard["robot"] and f"{PREFIX}/observation" in heard["operator"]

    assert both_ways(site.frames(WITHIN_S, speak, both_ways))
    proposed = site.frames(
        WITHIN_S, lambda: operator.put(f"{PREFIX}/proposal", b'{"input":{"v":0.1,"w":0.0}}'), lambda found: "proposal" in found
    )
    assert "proposal" in proposed
    site.frames(0.3, lambda: None)
    before = len(heard["robot"])
    assert site.frames(2.0, attack) == []  # everybody has had a link for seconds, or will never have one
    assert set(heard["robot"]) == {f"{PREFIX}/command"}
    assert len(heard["robot"]) > before  # and hears what the runtime says meanwhile
    assert set(heard["operator"]) == {f"{PREFIX}/observation"}
    assert {name: heard[name] for name in wrong} == {name: [] for name in wrong}


def test_a_robot_that_listens_is_only_believed_if_its_certificate_names_it(tmp_path: Path, stack: ExitStack) -> None:
    """The runtime connects; the names count for links in that direction as well."""
    heard = {}
    for who in ("visitor", "robot"):
        with ExitStack() as inner:
            folder, endpoint = tmp_path / who, free_endpoint().replace("tcp/", "tls/")
            site = Site(folder, inner, robot_listen="", robot_connect=endpoint)
            base = folder / "site" / who
            settings = {
                "root_ca_certificate": str(folder / "site" / "site.pem"),
                "listen_certificate": f"{base}.pem",
                "listen_private_key": f"{base}.key",
                "enable_mtls": True,
            }
            there = inner.enter_context(session("peer", listen=endpoint, transport__link__tls=settings))
            commands: list[str] = []
            hear(there, commands)

            def speak(there: Any = there, site: Site = site) -> None:
                there.put(f"{PREFIX}/observation", observation(site))
                site.command()

            found = site.frames(4.0 if who == "visitor" else WITHIN_S, speak, lambda found, c=commands: bool(found and c))
            heard[who] = (bool(found), bool(commands))
    assert heard == {"visitor": (False, False), "robot": (True, True)}


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"tls_key": ""}, "is set without tls_key"),
        ({"robot_listen": "tcp/127.0.0.1:1"}, "shows no certificates; with tls_ca it must begin with tls/"),
        ({"controller_listen": "udp/127.0.0.1:1"}, "shows no certificates"),
        ({"tls_ca": "", "tls_certificate": "", "tls_key": ""}, "nobody has a name without certificates"),
        ({"robot_names": "robot"}, "must be a list of text"),
        ({"robot_names": [""]}, "must be a list of common names"),
        ({"tls_ca": "/nowhere.pem"}, "cannot be read: No such file"),
    ],
)
def test_half_a_protection_is_refused(tmp_path: Path, stack: ExitStack, changed: dict[str, Any], words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        Site(tmp_path, stack, **changed)


def test_a_private_key_that_others_can_read_is_refused(tmp_path: Path, stack: ExitStack) -> None:
    tls.make(tmp_path / "loose", ["runtime"], [])
    (tmp_path / "loose" / "runtime.key").chmod(0o644)
    with pytest.raises(ConfigError, match="others than its owner can use"):
        Site(tmp_path, stack, tls_key=str(tmp_path / "loose" / "runtime.key"))


def test_certificates_are_added_to_an_authority_and_never_overwritten(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "tls"
    assert main(["keys", "tls", str(folder), "runtime", "robot", "--host", "192.168.7.1", "--host", "robot.local"]) == 0
    authority = (folder / "site.pem").read_bytes()
    assert main(["keys", "tls", str(folder), "operator", "--days", "30"]) == 0
    assert (folder / "site.pem").read_bytes() == authority
    assert "makes himself anybody" in capsys.readouterr().out
    assert {path.name: path.stat().st_mode & 0o777 for path in folder.glob("*.key")} == {
        f"{name}.key": 0o600 for name in ("site", "runtime", "robot", "operator")
    }
    with pytest.raises(ConfigError, match="is there already and is not overwritten"):
        tls.make(folder, ["robot"], [])
    for name in ("../up", "site", "", "-x", "a/b", "a b"):
        with pytest.raises(UsageError, match="must be a name of"):
            tls.make(folder, [name], [])
    with pytest.raises(UsageError, match="host name in ASCII"):
        tls.make(tmp_path / "third", ["robot"], ["röboter.local"])
    with pytest.raises(UsageError, match="must be 1 to 3650"):
        tls.make(tmp_path / "third", ["robot"], [], 10**9)
    assert not (tmp_path / "third").exists()
    (folder / "site.key").chmod(0o640)
    with pytest.raises(ConfigError, match="chmod 600"):
        tls.make(folder, ["late"], [])
    tls.make(tmp_path / "second", ["robot"], [])
    (folder / "site.key").write_bytes((tmp_path / "second" / "site.key").read_bytes())
    (folder / "site.key").chmod(0o600)
    with pytest.raises(ConfigError, match="is not the key of"):
        tls.make(folder, ["late"], [])
