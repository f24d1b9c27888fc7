"""The profile with mutual TLS: who has no certificate of the site gets no link, and who has another name gets nothing through it."""

from __future__ import annotations

import datetime
import ipaddress
import socket
import time
import tomllib
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest
from cryptography import x509
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import NameOID

zenoh = pytest.importorskip("zenoh")
from s2r_zenoh.testing import INPUTS, STATES, free_endpoint, session  # noqa: E402 - only where Zenoh is
from s2r_zenoh.transport import ZenohTransport  # noqa: E402

from s2r_runtime.cli.main import main  # noqa: E402
from s2r_runtime.errors import ConfigError, UsageError  # noqa: E402
from s2r_runtime.messages import Command  # noqa: E402
from s2r_runtime.trust import tls  # noqa: E402

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


def issued(folder: Path, name: str, *, common_name: str, from_s: float, to_s: float) -> None:
    """A certificate of the site's authority in the place of that one, valid between two times, in seconds from now."""
    ca, signer = tls._authority(folder)
    key, now = ec.generate_private_key(ec.SECP256R1()), datetime.datetime.now(datetime.UTC)
    made = (
        x509.CertificateBuilder()
        .subject_name(x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, common_name)]))
        .issuer_name(ca.subject)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now + datetime.timedelta(seconds=from_s))
        .not_valid_after(now + datetime.timedelta(seconds=to_s))
        .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
        .add_extension(x509.SubjectAlternativeName([x509.IPAddress(ipaddress.ip_address("127.0.0.1"))]), critical=False)
        .sign(signer, hashes.SHA256())
    )
    for suffix in (".pem", ".key"):
        (folder / f"{name}{suffix}").unlink(missing_ok=True)
    tls._write(folder, name, made, key)


HOUR, DAY = 3600.0, 86_400.0


def test_a_name_counts_only_while_its_certificate_does_and_letter_by_letter(tmp_path: Path, stack: ExitStack) -> None:
    site = Site(tmp_path, stack)
    folder = tmp_path / "site"
    issued(folder, "expired", common_name="robot", from_s=-2 * DAY, to_s=-DAY)
    issued(folder, "early", common_name="robot", from_s=DAY, to_s=2 * DAY)
    issued(folder, "wildcard", common_name="rob*", from_s=-HOUR, to_s=HOUR)
    issued(folder, "capital", common_name="Robot", from_s=-HOUR, to_s=HOUR)
    issued(folder, "longer", common_name="robot.site", from_s=-HOUR, to_s=HOUR)
    wrong = [site.link(f"site/{name}", site.robot_side) for name in ("expired", "early", "wildcard", "capital", "longer")]
    assert site.frames(4.0, lambda: [one.put(f"{PREFIX}/observation", observation(site)) for one in wrong] and None) == []
    robot = site.link("site/robot", site.robot_side)
    assert site.frames(WITHIN_S, lambda: robot.put(f"{PREFIX}/observation", observation(site)), bool)


def test_a_link_ends_when_the_certificate_of_its_other_end_expires(tmp_path: Path, stack: ExitStack) -> None:
    site = Site(tmp_path, stack)
    issued(tmp_path / "site", "short", common_name="robot", from_s=-HOUR, to_s=4.0)
    robot = site.link("site/short", site.robot_side)
    speak = lambda: robot.put(f"{PREFIX}/observation", observation(site))  # noqa: E731 - said three times
    assert site.frames(3.0, speak, bool)
    site.frames(4.0, speak)
    assert site.frames(2.0, speak) == []


@pytest.mark.parametrize("sent", [b"", b"\x16\x03\x01\x02\x00\x01", b"GET / HTTP/1.1\r\n\r\n", b"\x16\x03\x03\xff\xff"])
def test_peers_that_never_finish_their_handshake_keep_nobody_out(tmp_path: Path, stack: ExitStack, sent: bytes) -> None:
    site = Site(tmp_path, stack)
    for side in (site.robot_side, site.other_side):
        for _ in range(30):
            one = stack.enter_context(socket.create_connection(("127.0.0.1", int(side.rpartition(":")[2])), timeout=2.0))
            one.sendall(sent)
    robot = site.link("site/robot", site.robot_side)
    assert site.frames(WITHIN_S, lambda: robot.put(f"{PREFIX}/observation", observation(site)), bool)


def cut(file: Path) -> None:
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])


def foreign(file: Path) -> None:
    name = "site" if file.stem == "site" else "robot"
    file.write_bytes((file.parent.parent / "other" / f"{name}{file.suffix}").read_bytes())


@pytest.mark.parametrize("connects", [False, True], ids=["listens", "connects"])
@pytest.mark.parametrize(
    ("name", "spoil", "words"),
    [
        ("runtime.pem", cut, r"tls_certificate: .*runtime\.pem: holds no whole certificate"),
        ("runtime.pem", lambda file: file.write_bytes(b""), "holds no whole certificate"),
        ("runtime.key", cut, r"tls_key: .*runtime\.key: is no private key"),
        ("runtime.key", lambda file: file.write_bytes(bytes(range(256))), "is no private key"),
        ("runtime.key", foreign, r"is not the key of .*runtime\.pem"),
        ("site.pem", cut, r"tls_ca: .*site\.pem: holds no whole certificate"),
        ("site.pem", foreign, r"is not signed by an authority in .*site\.pem"),
        ("site.pem", lambda file: file.write_bytes(file.read_bytes() * 3000), "has more than 1048576 bytes"),
    ],
)
def test_certificates_that_do_not_fit_together_are_one_line_whoever_connects(
    tmp_path: Path, stack: ExitStack, connects: bool, name: str, spoil: Callable[[Path], object], words: str
) -> None:
    """Where the runtime connects, Zenoh would try for ever and never say why."""
    Site(tmp_path, stack)
    spoil(tmp_path / "site" / name)
    options = {"robot_connect": "tls/127.0.0.1:1"} if connects else {"robot_listen": free_endpoint().replace("tcp/", "tls/")}
    options |= {f"tls_{what}": str(tmp_path / "site" / file) for what, file in (("ca", "site.pem"), ("certificate", "runtime.pem"))}
    transport = ZenohTransport(options | {"tls_key": str(tmp_path / "site" / "runtime.key")}, STATES, INPUTS)
    stack.callback(transport.close)
    with pytest.raises(ConfigError, match=words) as refused:
        transport.open()
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(("from_s", "to_s", "words"), [(-2 * DAY, -DAY, "expired at 20"), (DAY, 2 * DAY, "is the clock right?")])
def test_an_own_certificate_that_is_out_of_date_is_named_where_nobody_is_heard(
    tmp_path: Path, stack: ExitStack, from_s: float, to_s: float, words: str
) -> None:
    """It starts all the same: a computer without a clock of its own learns the time later."""
    site = Site(tmp_path, stack)
    issued(tmp_path / "site", "runtime", common_name="runtime", from_s=from_s, to_s=to_s)
    site.transport.close()
    site.transport.open()
    (down,) = site.transport.poll(time.monotonic_ns() + 10**10)
    assert words in down.detail


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
