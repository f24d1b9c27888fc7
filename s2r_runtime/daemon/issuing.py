"""Certificates in the daemon: signed when the core says so, loaded when a person brings one; durable before the core hears of it."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from s2r_runtime.core.state import unix_now
from s2r_runtime.daemon.trust import certificate_file
from s2r_runtime.daemon.worker import Brought
from s2r_runtime.errors import ConfigError, S2RError
from s2r_runtime.files.durable import replace
from s2r_runtime.messages import CertificateFacts, CertificateFailed, CertificateStored, Gap, IssueCertificate
from s2r_runtime.trust import certificate as certificates
from s2r_runtime.trust import keys

if TYPE_CHECKING:
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

    from s2r_runtime.daemon.loop import Daemon


def signing_key(path: Path | None, state: Path, say: Callable[[str], None]) -> Ed25519PrivateKey:
    """The key at `path`; or the robot's own in the state folder, made when it has none. Raises ConfigError if it is no good."""
    if path is None:
        path = state / "key.pem"
        if not path.exists():
            public = keys.new(path)
            say(f"made a signing key for this robot: {path}; give {public} to whoever audits its logs")
    return keys.load(path)


def issue(daemon: Daemon, order: IssueCertificate) -> CertificateStored | CertificateFailed:
    """Signs what was shown and stores it."""
    file = daemon.actions.controller(order.verification.controller_digest)
    if problem := daemon.trust.own_objection():
        return CertificateFailed(0, problem, order.request_id)
    if file is None:
        return CertificateFailed(0, "the controller's file is not loaded any more; deploy it again", order.request_id)
    try:
        certificate = certificates.issue(
            profile=daemon.profile,
            controller=file,
            gap=order.gap,
            verification=order.verification,
            issued_unix_s=max(int(time.time()), unix_now(daemon.state)),
            lifetime_s=order.lifetime_s,
            horizon=daemon.facts.horizon,
            traced_not_adopted=daemon.state.memory.traced,
            tries=order.tries,
            runs=order.run_limits,
        )
        return _store(daemon, certificates.facts(certificate), certificates.sign(certificate, daemon.key), None, order.request_id)
    except S2RError as error:
        return CertificateFailed(0, str(error), order.request_id)


def take(daemon: Daemon, brought: Brought, request_id: int) -> CertificateStored:
    """A certificate that a person brought, made elsewhere and read by a worker. Raises ConfigError with what is wrong with it."""
    where, folder = "--certificate", daemon.folder.path
    objection = daemon.trust.objection(brought.signer)
    if "revoked" in objection:
        raise ConfigError(f"{where}: is {objection}; certify again with another key")
    if brought.untrusted:
        raise ConfigError(
            f"{brought.problem}; put the signer's public key (.pub) into {folder / 'trusted'}/, or run the daemon with the signer's key"
            f" (s2r run --key FILE), or certify with this daemon's (s2r certify --key {folder / 'key.pem'}, if run without --key)"
        )
    if brought.problem or brought.facts is None or objection:
        raise ConfigError(brought.problem or f"{where}: {objection or 'is none'}")
    stored = _store(daemon, brought.facts, brought.text.encode(), brought.gap, request_id)
    if isinstance(stored, CertificateFailed):
        raise S2RError(stored.error)
    return stored


def _store(daemon: Daemon, facts: CertificateFacts, data: bytes, gap: Gap | None, request_id: int) -> CertificateStored | CertificateFailed:
    """Into the log and the state folder, and to the disk."""
    folder = daemon.folder.path / "certificates"
    daemon.logbook.attach(f"certificate/{facts.id}", "application/json", data)
    try:
        folder.mkdir(mode=0o700, exist_ok=True)
        replace(certificate_file(folder, facts.id), data)
    except OSError as error:
        return CertificateFailed(0, f"the certificate cannot be stored: {error.strerror}", request_id)
    if not daemon.logbook.durable():
        return CertificateFailed(0, "the certificate cannot be logged: the disk does not take the log", request_id)
    return CertificateStored(0, facts, gap, request_id)
