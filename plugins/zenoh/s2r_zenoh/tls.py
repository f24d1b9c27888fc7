"""Mutual TLS: who is at the other end of a link, and whom a side of the transport has anything to do with.

Each end shows a certificate of the site's authority (mTLS), so that nobody else gets a link at all; and the common name in it says who it
is, so that of those who get one only the named get anything through it, in either direction (Zenoh's access control, by
`cert_common_names`). Without names every certificate of the authority counts.
"""

from __future__ import annotations

import os
import stat
from pathlib import Path
from typing import Any

from s2r_runtime.errors import ConfigError
from s2r_runtime.files.bounded_file import read_bounded

OPTIONS = {
    "tls_ca": "certificate of the site's authority (PEM); with it both sides are mTLS, and endpoints begin with tls/ or quic/",
    "tls_certificate": "the runtime's certificate, signed by it",
    "tls_key": "the certificate's private key, readable by its owner only",
    "robot_names": "common names, in their certificates, of who may be the robot (or the router it is behind); everybody else gets nothing",
    "controller_names": "the same on the controllers' side",
}
ENCRYPTED = ("tls/", "quic/")
FILE_MAX = 1 << 20
"""Bytes of a file of certificates at most: all authorities of a browser take 0.25 MB."""


def check(options: dict[str, Any]) -> None:
    """Raises ConfigError for options that promise more than they keep: names without certificates, certificates without encryption."""
    given = [name for name in ("tls_ca", "tls_certificate", "tls_key") if options[name]]
    for side in ("robot", "controller"):
        names = options[f"{side}_names"]
        if not all(isinstance(name, str) and name for name in names):
            raise ConfigError(f"transport.{side}_names is {names!r}, must be a list of common names")
        if names and not given:
            raise ConfigError(f"transport.{side}_names: nobody has a name without certificates; set tls_ca, tls_certificate and tls_key")
    if given and len(given) < 3:
        lacking = ", ".join({"tls_ca", "tls_certificate", "tls_key"} - set(given))
        raise ConfigError(f"transport.{given[0]} is set without {lacking}; it takes all three")
    if not given:
        return
    for name in ("robot_listen", "robot_connect", "controller_listen", "controller_connect"):
        if options[name] and not options[name].startswith(ENCRYPTED):
            raise ConfigError(
                f"transport.{name} is {options[name]!r}, which shows no certificates; with tls_ca it must begin with tls/ or quic/"
            )


def settings(options: dict[str, Any]) -> dict[str, Any]:
    """What the options mean for a session's configuration; empty without certificates. Raises ConfigError for a file that can't be used."""
    if not options["tls_ca"]:
        return {}
    from s2r_zenoh.own_certificate import check_pair  # which takes a library: for those who use certificates

    check_pair(options, *(content(name, Path(options[name])) for name in ("tls_ca", "tls_certificate", "tls_key")))
    certificate, key = options["tls_certificate"], options["tls_key"]
    return {
        "transport/link/tls/root_ca_certificate": options["tls_ca"],
        "transport/link/tls/listen_certificate": certificate,
        "transport/link/tls/listen_private_key": key,
        "transport/link/tls/connect_certificate": certificate,
        "transport/link/tls/connect_private_key": key,
        "transport/link/tls/enable_mtls": True,
        "transport/link/tls/verify_name_on_connect": True,
        "transport/link/tls/close_link_on_expiration": True,
    }


def subject(names: list[str]) -> dict[str, Any]:
    """Of the access control: links with these names, or every link."""
    return {"id": "named", "cert_common_names": names} if names else {"id": "every_link"}


def content(name: str, path: Path) -> bytes:
    """The file's bytes. Raises ConfigError if it can't be read, or if others can use a private key."""
    try:
        status = path.stat()
    except OSError as error:
        raise ConfigError(f"transport.{name}: {path}: cannot be read: {error.strerror}") from None
    if not stat.S_ISREG(status.st_mode) or not os.access(path, os.R_OK):
        raise ConfigError(f"transport.{name}: {path}: is no file that can be read")
    if name == "tls_key" and status.st_mode & 0o077:
        raise ConfigError(
            f"transport.{name}: others than its owner can use {path} (mode {stat.S_IMODE(status.st_mode):o}); chmod 600 {path}"
        )
    return read_bounded(path, FILE_MAX)
