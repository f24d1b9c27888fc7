"""Certificates for links: an authority of a site's own, and one certificate for each who speaks on its network.

    s2r keys tls DIR runtime robot operator --host 192.168.7.1

    DIR/site.pem, site.key      the authority: who has site.key makes himself anybody
    DIR/NAME.pem, NAME.key      one each, common name NAME, for the host names and addresses given

X.509, elliptic curve P-256. Keys are readable by their owner only. An authority that is there is used again, so names can be added; a name
that is there is not made anew. These are for a laboratory's network; who has an authority uses that.
"""

from __future__ import annotations

import datetime
import ipaddress
import os
import re
from collections.abc import Sequence
from pathlib import Path

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from s2r_runtime.errors import ConfigError, UsageError
from s2r_runtime.files.durable import check_own

AUTHORITY = "site"
DAYS = 365
AUTHORITY_DAYS = 3650
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,62}")


def make(folder: Path, names: Sequence[str], hosts: Sequence[str], days: int = DAYS) -> list[Path]:
    """Makes the authority, if there is none, and certificates for these names. Returns the certificates' files.

    hosts: under which these may be connected to. Raises UsageError for what is no name, ConfigError rather than overwrite anything.
    """
    for name in names:
        if not _NAME.fullmatch(name) or name == AUTHORITY:
            raise UsageError(f"{name!r}: must be a name of letters, digits, '_', '.' and '-', and not {AUTHORITY!r}")
        if any((folder / f"{name}{suffix}").exists() for suffix in (".pem", ".key")):
            raise ConfigError(f"{folder / name}.pem: is there already and is not overwritten; move it away, or choose another name")
    if not 1 <= days <= AUTHORITY_DAYS:
        raise UsageError(f"{days} days: must be 1 to {AUTHORITY_DAYS}, as long as an authority is valid")
    alternatives = [_host(host) for host in hosts]
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        authority, signer = _authority(folder)
        made = []
        for name in names:
            key = ec.generate_private_key(ec.SECP256R1())
            issued = _issue(name, key.public_key(), authority.subject, signer, days, [_host(name), *alternatives])
            made.append(_write(folder, name, issued, key))
    except OSError as error:
        raise ConfigError(f"{folder}: cannot be written: {error.strerror}") from None
    return made


def _authority(folder: Path) -> tuple[x509.Certificate, ec.EllipticCurvePrivateKey]:
    certificate, private = folder / f"{AUTHORITY}.pem", folder / f"{AUTHORITY}.key"
    if not (certificate.exists() or private.exists()):
        key = ec.generate_private_key(ec.SECP256R1())
        issued = _issue(AUTHORITY, key.public_key(), None, key, AUTHORITY_DAYS, ())
        _write(folder, AUTHORITY, issued, key)
        return issued, key
    check_own(private, "an authority's key")
    if private.stat().st_mode & 0o077:
        raise ConfigError(f"{private}: others than its owner can use this key; chmod 600 {private}")
    try:
        loaded = serialization.load_pem_private_key(private.read_bytes(), password=None)
        issued = x509.load_pem_x509_certificate(certificate.read_bytes())
    except (ValueError, TypeError) as error:
        raise ConfigError(f"{certificate}, {private}: are no authority: {error}") from None
    if not isinstance(loaded, ec.EllipticCurvePrivateKey) or loaded.public_key() != issued.public_key():
        raise ConfigError(f"{private}: is not the key of {certificate}")
    return issued, loaded


def _issue(
    name: str,
    public: ec.EllipticCurvePublicKey,
    issuer: x509.Name | None,
    signer: ec.EllipticCurvePrivateKey,
    days: int,
    hosts: Sequence[x509.GeneralName],
) -> x509.Certificate:
    """issuer None: an authority, signed by itself."""
    now = datetime.datetime.now(datetime.UTC)
    subject = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])
    builder = (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(issuer or subject)
        .public_key(public)
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - datetime.timedelta(hours=1))  # clocks on a robot's network differ
        .not_valid_after(now + datetime.timedelta(days=days))
        .add_extension(x509.BasicConstraints(ca=issuer is None, path_length=0 if issuer is None else None), critical=True)
    )
    if issuer is not None:
        both = [ExtendedKeyUsageOID.SERVER_AUTH, ExtendedKeyUsageOID.CLIENT_AUTH]
        builder = builder.add_extension(x509.ExtendedKeyUsage(both), critical=False)
        builder = builder.add_extension(x509.SubjectAlternativeName(hosts), critical=False)
    return builder.sign(signer, hashes.SHA256())


def _host(text: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ipaddress.ip_address(text))
    except ValueError:
        pass
    try:
        return x509.DNSName(text)
    except ValueError:
        raise UsageError(f"{text!r}: must be an address, or a host name in ASCII (xn--... for others)") from None


def _write(folder: Path, name: str, certificate: x509.Certificate, key: ec.EllipticCurvePrivateKey) -> Path:
    private = key.private_bytes(serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption())
    path = folder / f"{name}.pem"
    for file, data, mode in (
        (path.with_suffix(".key"), private, 0o600),
        (path, certificate.public_bytes(serialization.Encoding.PEM), 0o644),
    ):
        descriptor = os.open(file, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, mode)
        with os.fdopen(descriptor, "wb") as stream:
            os.fchmod(descriptor, mode)
            stream.write(data)
    return path
