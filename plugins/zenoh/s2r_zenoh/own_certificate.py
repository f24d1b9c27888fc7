"""The runtime's own certificate: whether its files belong together, and whether its dates hold."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from cryptography import x509
from cryptography.exceptions import InvalidSignature, UnsupportedAlgorithm
from cryptography.hazmat.primitives import serialization

from s2r_runtime.errors import ConfigError
from s2r_zenoh.tls import content


def check_pair(options: dict[str, Any], ca: bytes, own: bytes, private: bytes) -> None:
    """Raises ConfigError unless the three files belong together. A link made later would fail without a word: Zenoh only retries."""
    authorities, chain = _certificates("tls_ca", options, ca), _certificates("tls_certificate", options, own)
    try:
        key = serialization.load_pem_private_key(private, password=None)
    except (ValueError, TypeError, UnsupportedAlgorithm):
        raise ConfigError(f"transport.tls_key: {options['tls_key']}: is no private key in PEM form, or has a password") from None
    if key.public_key() != chain[0].public_key():
        raise ConfigError(f"transport.tls_key: {options['tls_key']}: is not the key of {options['tls_certificate']}")
    if not any(_signed_by(chain[0], issuer) for issuer in (*chain[1:], *authorities)):
        raise ConfigError(f"transport.tls_certificate: {options['tls_certificate']}: is not signed by an authority in {options['tls_ca']}")


def invalidity(options: dict[str, Any], unix_s: float) -> str:
    """Why nobody believes the runtime's own certificate at that time, by its dates; or empty. Call it after `settings`."""
    path = options["tls_certificate"]
    try:
        own = x509.load_pem_x509_certificate(content("tls_certificate", Path(path)))
    except (ConfigError, ValueError):  # it was replaced meanwhile; the link has its own copy
        return ""
    if unix_s > own.not_valid_after_utc.timestamp():
        return f"the runtime's certificate {path} expired at {own.not_valid_after_utc:%Y-%m-%dT%H:%M:%SZ}"
    if unix_s < own.not_valid_before_utc.timestamp():
        return f"the runtime's certificate {path} is valid from {own.not_valid_before_utc:%Y-%m-%dT%H:%M:%SZ} on; is the clock right?"
    return ""


def _certificates(name: str, options: dict[str, Any], pem: bytes) -> list[x509.Certificate]:
    try:
        return x509.load_pem_x509_certificates(pem)
    except ValueError:
        raise ConfigError(f"transport.{name}: {options[name]}: holds no whole certificate in PEM form") from None


def _signed_by(certificate: x509.Certificate, issuer: x509.Certificate) -> bool:
    try:
        certificate.verify_directly_issued_by(issuer)
    except (ValueError, TypeError, InvalidSignature):
        return False
    return True
