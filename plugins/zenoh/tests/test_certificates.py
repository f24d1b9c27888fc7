"""With certificates on the robot's side, only who has one gets as far as a link."""

from __future__ import annotations

import datetime
import ipaddress
import json
import re
import threading
from contextlib import ExitStack
from pathlib import Path

import pytest
import zenoh
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import NameOID
from s2r_zenoh.testing import INPUTS, STATES, free_endpoint, session
from s2r_zenoh.transport import ZenohTransport

from s2r_runtime.messages import Command

OBSERVATION = b'{"seq":1,"stamp_ns":1,"state":{"x":0.1,"y":0.2,"theta":0.3}}'


def authority(folder: Path, name: str) -> tuple[ec.EllipticCurvePrivateKey, x509.Certificate]:
    key = ec.generate_private_key(ec.SECP256R1())
    subject = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])
    certificate = _issue(subject, subject, key.public_key(), key, authority=True)
    (folder / f"{name}.pem").write_bytes(certificate.public_bytes(serialization.Encoding.PEM))
    return key, certificate


def member(folder: Path, name: str, ca: tuple[ec.EllipticCurvePrivateKey, x509.Certificate]) -> None:
    key = ec.generate_private_key(ec.SECP256R1())
    subject = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])
    certificate = _issue(subject, ca[1].subject, key.public_key(), ca[0], authority=False)
    (folder / f"{name}.pem").write_bytes(certificate.public_bytes(serialization.Encoding.PEM))
    private = key.private_bytes(serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption())
    (folder / f"{name}.key").write_bytes(private)


def _issue(
    subject: x509.Name, issuer: x509.Name, public: ec.EllipticCurvePublicKey, signer: ec.EllipticCurvePrivateKey, *, authority: bool
) -> x509.Certificate:
    now = datetime.datetime.now(datetime.UTC)
    return (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(issuer)
        .public_key(public)
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - datetime.timedelta(hours=1))
        .not_valid_after(now + datetime.timedelta(hours=1))
        .add_extension(x509.BasicConstraints(ca=authority, path_length=None), critical=True)
        .add_extension(x509.SubjectAlternativeName([x509.IPAddress(ipaddress.ip_address("127.0.0.1"))]), critical=False)
        .sign(signer, hashes.SHA256())
    )


def tls(folder: Path, name: str, ca: str) -> dict[str, object]:
    return {
        "root_ca_certificate": str(folder / f"{ca}.pem"),
        "listen_private_key": str(folder / f"{name}.key"),
        "listen_certificate": str(folder / f"{name}.pem"),
        "connect_private_key": str(folder / f"{name}.key"),
        "connect_certificate": str(folder / f"{name}.pem"),
        "enable_mtls": True,
    }


def heard_by_runtime(transport: ZenohTransport, folder: Path, name: str, ca: str, endpoint: str) -> bool:
    """Whether an observation of somebody with this certificate arrives."""
    settings = {"transport__link__tls": tls(folder, name, ca)} if name else {}
    with session("peer", connect=endpoint, **settings) as somebody:
        publisher = somebody.declare_publisher("s2r/robot/observation")
        pause = threading.Event()
        for _ in range(40):
            publisher.put(OBSERVATION)
            pause.wait(0.05)
            if transport.receive():
                return True
    return False


def test_only_a_robot_with_a_certificate_of_the_sites_authority_is_heard(tmp_path: Path) -> None:
    site, other = authority(tmp_path, "site"), authority(tmp_path, "other")
    member(tmp_path, "runtime", site)
    member(tmp_path, "robot", site)
    member(tmp_path, "stranger", other)
    config = tmp_path / "robot_side.json5"
    config.write_text(json.dumps({"transport": {"link": {"tls": tls(tmp_path, "runtime", "site")}}}), encoding="utf-8")
    endpoint = free_endpoint().replace("tcp/", "tls/")
    transport = ZenohTransport({"robot_listen": endpoint, "robot_config": str(config)}, STATES, INPUTS)
    try:
        transport.open()
        assert not heard_by_runtime(transport, tmp_path, "stranger", "site", endpoint)
        assert not heard_by_runtime(transport, tmp_path, "", "", endpoint)
        assert heard_by_runtime(transport, tmp_path, "robot", "site", endpoint)
    finally:
        transport.close()


@pytest.mark.parametrize("closed", [True, False])
def test_router_lets_only_the_runtime_command_the_robot_with_the_rules_of_the_docs(tmp_path: Path, closed: bool) -> None:
    site = authority(tmp_path, "site")
    for name in ("router", "runtime", "robot", "visitor"):
        member(tmp_path, name, site)
    endpoint = free_endpoint().replace("tcp/", "tls/")
    page = (Path(__file__).parents[3] / "docs" / "zenoh.md").read_text(encoding="utf-8")
    (text,) = [b for b in re.findall(r"^```json5\n(.*?)^```$", page, re.MULTILINE | re.DOTALL) if "access_control" in b]
    rules = json.loads(zenoh.Config.from_json5(text).get_json("access_control"))
    config = tmp_path / "robot_side.json5"
    config.write_text(json.dumps({"transport": {"link": {"tls": tls(tmp_path, "runtime", "site")}}}), encoding="utf-8")
    transport = ZenohTransport({"robot_connect": endpoint, "robot_config": str(config)}, STATES, INPUTS)
    heard: list[bytes] = []
    with ExitStack() as stack:
        router = tls(tmp_path, "router", "site")
        stack.enter_context(
            session("router", listen=endpoint, transport__link__tls=router, access_control=rules if closed else {"enabled": False})
        )
        robot = stack.enter_context(session("client", connect=endpoint, transport__link__tls=tls(tmp_path, "robot", "site")))
        visitor = stack.enter_context(session("client", connect=endpoint, transport__link__tls=tls(tmp_path, "visitor", "site")))
        stack.callback(transport.close)
        transport.open()
        robot.declare_subscriber("s2r/robot/command", lambda s: heard.append(s.payload.to_bytes()))
        pause, received = threading.Event(), 0
        for k in range(200):
            robot.put("s2r/robot/observation", OBSERVATION.replace(b'"seq":1', b'"seq":%d' % k))
            transport.send(transport.encode(Command(k, k, "recovery", (0.0, 0.0), k, 1)))
            for key in ("s2r/robot/command", "s2r/**", "**"):
                visitor.put(key, b"attack")
            pause.wait(0.02)
            received += len(transport.receive())
            if received > 20 and len(heard) > 20:
                break
        pause.wait(0.3)
    assert received > 20
    assert len(heard) > 20
    assert any(b"attack" in data for data in heard) is not closed
