"""Finds plug-ins by entry point, each loaded on its own: one that fails is reported and skipped, never fatal.

Names are unique over all plug-ins. Where two offer the same name the later one is refused and both distributions are named;
built-in names are taken first, so a third party cannot replace one. What a plug-in raises on the way, SystemExit included, is its report
(`s2r plugin list`); only Ctrl-C is the user's.
"""

from __future__ import annotations

import difflib
import importlib
import re
from collections.abc import Callable
from functools import cache
from importlib import metadata
from typing import Any, NamedTuple

import pluggy

from s2r_runtime import hookspecs
from s2r_runtime.errors import PluginError, one_line
from s2r_runtime.hookspecs import API_VERSION, GROUP, Offer

KINDS = ("transports", "models", "effects", "tasks", "recordings", "formats", "robots", "kits")
NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.-]{0,63}")
TARGET = re.compile(r"\w+(\.\w+)*:\w+")
OFFERS_MOST = 1000
"""Of one kind by one plug-in: a list, not a stream."""

INSTALL = {"zenoh": "s2r-zenoh", "mavlink": "s2r-mavlink", "can": "s2r-can", "robotarium": "s2r-standins"}
"""Names that a package of this project offers, for the hint when it is not installed."""


class Loaded(NamedTuple):
    """One plug-in as found. `error` is empty iff all of it is in use; `offers`: kind -> names. `origin`: the file or folder that it came
    from; `api`: the version of the interface that it was written for (0: not known, it could not be loaded).
    """

    name: str
    distribution: str
    version: str
    error: str
    offers: dict[str, tuple[str, ...]]
    origin: str = ""
    api: int = 0


class Offered(NamedTuple):
    """An offer in force and the distribution that made it."""

    offer: Offer
    distribution: str


class Registry:
    """What is offered, by kind and name. `loaded` lists every plug-in found, the broken ones with their error."""

    def __init__(self) -> None:
        self.loaded: list[Loaded] = []
        self._offers: dict[str, dict[str, Offered]] = {kind: {} for kind in KINDS}

    def add(self, name: str, distribution: str, version: str, module: object) -> None:
        """Takes a plug-in module's offers. A name already taken is refused with both distributions named."""
        origin = str(getattr(module, "__file__", None) or "")
        if known := next((p.distribution for p in self.loaded if p.name == name), ""):
            self.fail(
                name, distribution, version, f"the plug-in {name!r} of {distribution} is refused: {known} has one of that name", origin
            )
            return
        manager = pluggy.PluginManager(GROUP)
        manager.add_hookspecs(hookspecs)
        try:
            wanted: object = getattr(module, "S2R_API_VERSION", API_VERSION)
            if wanted != API_VERSION:
                self.fail(name, distribution, version, f"written for plug-in API {wanted}, this is API {API_VERSION}", origin)
                return
            manager.register(module, name)
            manager.check_pending()
        except KeyboardInterrupt:
            raise
        except BaseException as error:  # noqa: BLE001 - a third party's module: whatever it raises is its report, not our end
            self.fail(name, distribution, version, said(error), origin)
            return
        errors: list[str] = []
        taken: dict[str, tuple[str, ...]] = {}
        for kind in KINDS:
            try:
                offers = _offers(getattr(manager.hook, f"s2r_{kind}")())
            except KeyboardInterrupt:
                raise
            except BaseException as error:  # noqa: BLE001 - as above
                errors.append(f"s2r_{kind}: {said(error)}")
                continue
            taken[kind] = tuple(new for offer in offers if (new := self._take(kind, offer, distribution, errors)))
        offered = {kind: names for kind, names in taken.items() if names}
        self.loaded.append(Loaded(name, distribution, version, "; ".join(errors), offered, origin, API_VERSION))

    def fail(self, name: str, distribution: str, version: str, error: str, origin: str = "") -> None:
        """Notes a plug-in that could not be loaded."""
        self.loaded.append(Loaded(name, distribution, version, error, {}, origin))

    def _take(self, kind: str, offer: object, distribution: str, errors: list[str]) -> str:
        """The offer's name if it is in force now, else empty."""
        if not isinstance(offer, Offer):
            errors.append(f"s2r_{kind}: offers {type(offer).__name__}, must be Offer(name, target)")
            return ""
        if not isinstance(offer.name, str) or not NAME.fullmatch(offer.name):
            errors.append(one_line(f"s2r_{kind}: offers the name {offer.name!r}, must be letters, digits, _ . -"))
            return ""
        if not isinstance(offer.target, str) or not TARGET.fullmatch(offer.target):
            errors.append(one_line(f"s2r_{kind}: {offer.name} has the target {offer.target!r}, must be module:attribute"))
            return ""
        for target in (offer.recognises, offer.normal_form):
            if not isinstance(target, str) or (target and not TARGET.fullmatch(target)):
                errors.append(one_line(f"s2r_{kind}: {offer.name} names the function {target!r}, must be module:attribute"))
                return ""
        known = self._offers[kind].get(offer.name)
        if known is not None:
            errors.append(f"{kind[:-1]} {offer.name!r} of {distribution} is refused: {known.distribution} has that name")
            return ""
        self._offers[kind][offer.name] = Offered(offer, distribution)
        return offer.name

    def names(self, kind: str) -> list[str]:
        """Registered names of a kind, sorted."""
        return sorted(self._offers[kind])

    def offered(self, kind: str, name: str) -> Offered:
        """The offer of that name. Raises PluginError with the nearest name, or what to install."""
        found = self._offers[kind].get(name)
        if found is None:
            raise PluginError(f"unknown {kind[:-1]} {name!r}" + self._hint(kind, name))
        return found

    def get(self, kind: str, name: str) -> Any:
        """Imports and returns what is offered. Raises PluginError if it is unknown or its import fails."""
        return self._load(kind, name, self.offered(kind, name).offer.target)

    def recogniser(self, name: str) -> Callable[[bytes], bool]:
        """The function by which a recording's reader recognises a file by its first bytes. Without one, it recognises none.

        Raises PluginError if its import fails.
        """
        target = self.offered("recordings", name).offer.recognises
        found: Callable[[bytes], bool] = self._load("recordings", name, target) if target else _recognises_nothing
        return found

    def normal_form(self, transport: str) -> Callable[[dict[str, Any], str], str] | None:
        """The function that gives what a file of a transport states (`Offer.normal_form`), if it has one. Raises PluginError."""
        target = self.offered("transports", transport).offer.normal_form
        found: Callable[[dict[str, Any], str], str] | None = self._load("transports", transport, target) if target else None
        return found

    def _load(self, kind: str, name: str, target: str) -> Any:
        module, _, attribute = target.partition(":")
        try:
            return getattr(importlib.import_module(module), attribute)
        except KeyboardInterrupt:
            raise
        except BaseException as error:  # noqa: BLE001 - as in `add`
            distribution = self.offered(kind, name).distribution
            raise PluginError(f"{kind[:-1]} {name!r} of {distribution} cannot be loaded: {said(error)}") from None

    def _hint(self, kind: str, name: str) -> str:
        broken = [f"{p.name} ({p.error})" for p in self.loaded if p.error]
        if near := difflib.get_close_matches(name, self.names(kind), 1, 0.6):
            return f"; did you mean {near[0]!r}?"
        if name in INSTALL:
            return f"; install the package {INSTALL[name]}" + (f"; plug-ins that failed: {', '.join(broken)}" if broken else "")
        return f"; there are: {', '.join(self.names(kind)) or 'none'}"


@cache
def registry() -> Registry:
    """Everything installed, built-ins first. Loaded once a process."""
    found = Registry()
    found.add("builtin", "s2r-runtime", _version("s2r-runtime"), importlib.import_module("s2r_runtime.builtin"))
    points = sorted(metadata.entry_points(group=GROUP), key=lambda p: ((p.dist.name if p.dist else ""), p.name))
    for point in points:
        distribution, version = (point.dist.name, point.dist.version) if point.dist else ("?", "?")
        try:
            module = point.load()
        except KeyboardInterrupt:
            raise
        except BaseException as error:  # noqa: BLE001 - as in `Registry.add`
            found.fail(point.name, distribution, version, said(error), _folder(point))
            continue
        found.add(point.name, distribution, version, module)
    return found


def _recognises_nothing(_head: bytes) -> bool:
    return False


def said(error: BaseException) -> str:
    """What somebody else's code raised, on one line."""
    return one_line(f"{type(error).__name__}: {error}")


def _offers(given: object) -> list[object]:
    """What a hook of one plug-in gave: pluggy makes a list of the answers. Raises TypeError."""
    found: list[object] = []
    for offers in given if isinstance(given, list) else [given]:
        if not isinstance(offers, list | tuple) or len(offers) > OFFERS_MOST:
            raise TypeError(f"gives {type(offers).__name__}, must be a list of Offer")
        found += offers
    return found


def _folder(point: metadata.EntryPoint) -> str:
    """Where a plug-in that could not be imported is installed."""
    return str(point.dist.locate_file("")) if point.dist else ""


def _version(distribution: str) -> str:
    try:
        return metadata.version(distribution)
    except metadata.PackageNotFoundError:
        return "?"
