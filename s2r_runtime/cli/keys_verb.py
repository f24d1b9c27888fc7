"""s2r keys: make, list, rotate and revoke the keys that sign certificates and logs (docs/threat-model.md)."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path

from s2r_runtime.cli import output
from s2r_runtime.cli.choices import count
from s2r_runtime.errors import S2RError, UsageError


def add(verbs: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Adds the verb."""
    keys = verbs.add_parser("keys").add_subparsers(dest="what", metavar="WHAT", required=True)
    new = keys.add_parser("new", help="make a key pair that signs certificates and logs")
    new.add_argument("path", type=Path, nargs="?", metavar="FILE", help="where (default: the user's configuration folder)")
    new.set_defaults(run=keys_new)
    listing = keys.add_parser("list", help="which keys there are here, which are trusted, and which are revoked")
    listing.add_argument("--state", type=Path, metavar="DIR", help="a robot's state folder: its own key, and those that it trusts")
    listing.add_argument("--json", action="store_true", help="print one JSON object")
    listing.set_defaults(run=keys_list)
    rotate = keys.add_parser("rotate", help="put a new key in an old one's place; the budget that was spent with it stays spent")
    rotate.add_argument("path", type=Path, nargs="?", metavar="FILE", help="the private key (default: the user's)")
    rotate.add_argument(
        "--trust-old",
        action="store_true",
        help="of a robot's own key: certificates that the old one signed stay in force (else the robot's next start revokes them)",
    )
    rotate.set_defaults(run=keys_rotate)
    revoke = keys.add_parser("revoke", help="never believe a key again: what it signed ends, and it signs no more")
    revoke.add_argument("key", metavar="KEY", help="its .pub file, or its fingerprint (s2r keys list)")
    revoke.add_argument("--reason", default="", metavar="TEXT", help="what the logs and everybody who is refused are told")
    revoke.add_argument(
        "--state", type=Path, metavar="DIR", help="on the list of this robot only (default: the user's, for all his robots)"
    )
    revoke.set_defaults(run=keys_revoke)
    tls = keys.add_parser("tls", help="certificates for links: an authority of a site's own, and one certificate for each name")
    tls.add_argument("folder", type=Path, metavar="DIR", help="where; an authority that is there signs the new ones too")
    tls.add_argument("names", nargs="+", metavar="NAME", help="who speaks on the network, such as runtime, robot, operator")
    tls.add_argument("--host", action="append", default=[], metavar="H", help="address or name they are connected to at; may be repeated")
    tls.add_argument("--days", type=count, default=365, metavar="N", help="how long they are valid (default 365)")
    tls.set_defaults(run=keys_tls)


def keys_new(args: argparse.Namespace) -> int:
    """Makes a key pair; refuses to overwrite one."""
    from s2r_runtime.trust import keys

    path = args.path or keys.default_path()
    public = keys.new(path)
    output.out(f"private key  {path}  (keep it on the machine that signs; readable by its owner only)")
    output.out(f"public key   {public}  (give it to whoever checks: s2r audit LOG --key {public})")
    return 0


def keys_rotate(args: argparse.Namespace) -> int:
    """Puts a new pair in the old one's place. Exit 0 when it is there."""
    from s2r_runtime.trust import keys, revocations

    path = args.path or keys.default_path()
    if args.trust_old and not (path.parent / "state.json").exists():
        raise UsageError(
            f"--trust-old: {path.parent} is no robot's state folder; put the old public key where it is to be trusted yourself"
        )
    before = keys.fingerprint(keys.public_bytes(keys.load(path, revoked=True)))
    if args.trust_old and (entry := revocations.known(revocations.places(path.parent)).get(before)) is not None:
        raise UsageError(f"--trust-old: the key {before} was {entry}; nothing makes it trusted again")
    public, kept = keys.rotate(path)
    if args.trust_old:
        keys.trust(kept, path.parent / "trusted")
    now = keys.fingerprint(keys.load_public(public))
    output.out(f"new key  {now}  in {path}; its ledger goes on. Give {public} to whoever audits")
    output.out(f"old key  {before}  signs nothing any more; its public half is {kept}, for the logs and certificates that it signed")
    if args.trust_old:
        output.out(
            "certificates that the old key signed stay in force until they expire; if others may have it: s2r keys revoke " + str(kept)
        )
    else:
        output.out("a daemon that runs goes on with the old one until it is started anew; certificates that the old one signed end there")
    return 0


def keys_revoke(args: argparse.Namespace) -> int:
    """Puts a key on the list. Exit 0 when it stands there, durably."""
    from s2r_runtime.trust import keys, revocations

    if args.state is not None and not args.state.is_dir():
        raise UsageError(f"{args.state}: there is no such state folder, so no daemon would read a list there; nothing was revoked")
    given = Path(args.key)
    name = args.key if revocations.FINGERPRINT.fullmatch(args.key) or not given.is_file() else keys.fingerprint(keys.load_public(given))
    path = (args.state or keys.config_dir()) / revocations.NAME
    entry = revocations.revoke(path, name, args.reason)
    output.out(f"{name} {entry} (on {path})")
    output.out("daemons that read this list refuse it within a second: what it signed ends, and gates that stood open on it close")
    return 0


def keys_list(args: argparse.Namespace) -> int:
    """Exit 0; what is wrong with a key's file stands beside it."""
    from s2r_runtime.trust import keys, revocations

    folders = [keys.config_dir(), *([args.state] if args.state else [])]
    revoked = revocations.known(revocations.places(*folders[1:]))
    private = [path for folder in folders for path in sorted({*folder.glob("*.key"), *folder.glob("*.pem")})]
    trusted = sorted((args.state / "trusted").glob("*.pub")) if args.state else []
    found = [_described("signs", path, lambda p: keys.public_bytes(keys.load(p, revoked=True))) for path in private]
    found += [_described("trusted", path, keys.load_trusted_file) for path in trusted]
    for one in found:
        one["revoked"] = str(revoked[one["fingerprint"]]) if one["fingerprint"] in revoked else ""
    others = revoked.keys() - {one["fingerprint"] for one in found}
    found += [{"use": "revoked", "fingerprint": name, "path": "", "problem": "", "revoked": str(revoked[name])} for name in sorted(others)]
    if args.json:
        output.result_json({"keys": found})
        return 0
    for one in found:
        output.out(f"{one['use']:8s} {one['fingerprint'] or '?':40s} {one['path']}" + _told(one))
    if not found:
        output.out(f"no keys in {', '.join(map(str, folders))}; make one: s2r keys new")
    return 0


def keys_tls(args: argparse.Namespace) -> int:
    """Exit 0 when they are there."""
    from s2r_runtime.trust import tls

    for path in tls.make(args.folder, args.names, args.host, args.days or tls.DAYS):
        output.out(f"{path.stem:12s} {path}, {path.with_suffix('.key').name}")
    output.out(
        f"authority    {args.folder / 'site.pem'}  (to everybody; keep site.key where nothing else runs: who has it makes himself anybody)"
    )
    return 0


def _described(use: str, path: Path, load: Callable[[Path], bytes]) -> dict[str, str]:
    from s2r_runtime.trust import keys

    try:
        return {"use": use, "fingerprint": keys.fingerprint(load(path)), "path": str(path), "problem": ""}
    except S2RError as error:
        return {"use": use, "fingerprint": "", "path": str(path), "problem": str(error)}


def _told(one: dict[str, str]) -> str:
    return "".join(f"  {output.styled(text, 'red')}" for text in (one["revoked"], one["problem"]) if text)
