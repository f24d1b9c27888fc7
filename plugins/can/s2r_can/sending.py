"""Which frames a command is made of, and who guards them: the outbound half of a `Layout`, counters and checksums of both.

A command frame holds the inputs; its multiplexers are set so that they are there; constants are as the profile says; every other signal is
what the DBC starts it with, or else zero.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from s2r_can.addresses import keyed
from s2r_can.bits import Scaled, Selector, bits_of, selectors_of
from s2r_can.checksums import guarded, scheme_of
from s2r_can.database import Database, Named
from s2r_can.layout import Counter, Inbound, Layout, Outbound, scaled
from s2r_can.options import CounterOption, Options
from s2r_runtime.errors import ConfigError

if TYPE_CHECKING:
    from cantools.database.can import Message, Signal

Constants = dict[tuple[str, str], float]

ZERO = 1e-6
"""Of a signal's step and offset: what rounding leaves of zero."""


def outbound(options: Options, database: Database, inputs: tuple[str, ...]) -> list[Outbound]:
    """A frame a message, or a branch of a multiplexed one. Raises ConfigError."""
    frames: dict[tuple[int, tuple[Selector, ...]], list[tuple[int, Named, Scaled]]] = {}
    messages: dict[int, Message] = {}
    for index, name in enumerate(inputs):
        where = f"transport.inputs.{name}"
        named = database.signal(options.inputs[name].signal, where)
        signal = scaled(named, options.inputs[name], where)
        _stops(signal, where)
        key = keyed(named.message, options)
        messages[key] = named.message
        frames.setdefault((key, selectors_of(named.message, named.signal, where)), []).append((index, named, signal))
    constants = _constants(options, database, {message.name for message in messages.values()})
    found = []
    for key, message in messages.items():
        branches: list[tuple[Selector, ...]] = [selectors for k, selectors in frames if k == key and selectors] or [()]
        for selectors in branches:
            held = frames.get((key, selectors), []) + (frames.get((key, ()), []) if selectors else [])
            base = _base(message, selectors, constants, {named.signal.name for _, named, _ in held})
            fd = bool(message.is_fd) or message.length > 8
            inputs_held = [(index, signal) for index, _, signal in held]
            found.append(Outbound(message.name, key, message.length, fd, selectors, inputs_held, base))
    return found


def _stops(signal: Scaled, where: str) -> None:
    """Zero input stops the robot; a signal that cannot say zero would let it creep. Raises ConfigError."""
    what = f"{where}: zero input, which stops the robot, cannot be sent"
    try:
        raw = signal.raw_of(0.0)
        signal.bits.placed(raw)
    except ValueError as error:
        raise ConfigError(f"{what}: {error}") from None
    said = (raw * signal.scale + signal.offset) * signal.factor + signal.shift_si
    if abs(said) > ZERO * abs(signal.factor) * (abs(signal.scale) + abs(signal.offset)):
        raise ConfigError(f"{what}: the nearest that {signal.bits.name} can say is {said:g}")


def _constants(options: Options, database: Database, commands: set[str]) -> Constants:
    found = {}
    for name, value in options.constants.items():
        where = f"transport.constants.{name}"
        named = database.signal(name, where)
        if named.message.name not in commands:
            raise ConfigError(f"{where}: {named.message.name} holds no input; constants belong to commands ({', '.join(sorted(commands))})")
        found[named.message.name, named.signal.name] = value
    return found


def _base(message: Message, selectors: tuple[Selector, ...], constants: Constants, taken: set[str]) -> tuple[int, int]:
    """(little, big): all that is the same in every command."""
    little = big = 0
    selecting = {bits.name.partition(".")[2]: ids for bits, ids in selectors}
    for signal in message.signals:
        if signal.name in taken or not _there(message, signal, selecting):
            continue
        where = f"transport.constants.{message.name}.{signal.name}"
        bits = bits_of(message, signal, where)
        raw = _constant(signal, constants.get((message.name, signal.name)), bits.limits())
        if signal.name in selecting and raw not in selecting[signal.name]:
            raw = min(selecting[signal.name])
        try:
            more = bits.placed(raw)
        except ValueError as error:
            raise ConfigError(f"{where}: {error}") from None
        little, big = little | more[0], big | more[1]
    return little, big


def _there(message: Message, signal: Signal, selecting: dict[str, frozenset[int]]) -> bool:
    """Whether the signal is in the frame of this branch."""
    needed = selectors_of(message, signal, f"message {message.name}")
    return all(min(selecting.get(bits.name.partition(".")[2], {-1})) in ids for bits, ids in needed)


def _constant(signal: Signal, given: float | None, limits: tuple[int, int]) -> float:
    """Raw value of a signal that is no input."""
    real = signal.conversion.is_float
    if given is None and signal.raw_initial is not None:
        return float(signal.raw_initial) if real else round(float(signal.raw_initial))
    raw = ((given or 0.0) - float(signal.offset)) / float(signal.scale)
    if given is None and not real and not limits[0] <= raw <= limits[1]:
        return 0
    return raw if real else round(raw)


def protect(layout: Layout, options: Options, database: Database) -> None:
    """Adds counters and checksums to the messages that have them; those of messages that are not used wait for it. Raises ConfigError."""
    for table, entries in (("counters", options.counters), ("checksums", options.checksums)):
        for name, option in entries.items():
            where = f"transport.{table}.{name}"
            message = database.message(name, where)
            key = keyed(message, options)
            users: list[Inbound | Outbound] = [out for out in layout.outbound if out.key == key]
            users += [layout.inbound[key]] if key in layout.inbound else []
            signal = database.signal_in(message, str(option.signal).removeprefix(f"{name}."), where).signal
            if selectors_of(message, signal, where):
                raise ConfigError(f"{where}: {signal.name} is multiplexed, so not every frame has it")
            bits = bits_of(message, signal, where)
            if bits.real is not None or bits.sign:
                raise ConfigError(f"{where}: {signal.name} must be an unsigned integer")
            for user in users:
                if isinstance(user, Outbound):  # nothing constant may be there
                    little, big = bits.placed(bits.mask)
                    user.base = user.base[0] & ~little, user.base[1] & ~big
                if isinstance(option, CounterOption):
                    modulus = option.modulus or 1 << bits.length
                    if not 2 <= modulus <= 1 << bits.length:
                        raise ConfigError(
                            f"{where}.modulus is {modulus}, must be in 2 to {1 << bits.length}: {signal.name} has {bits.length} bits"
                        )
                    user.counter = Counter(bits, modulus, option.jump, round((message.cycle_time or 0) * 1e6))
                else:
                    little, big = bits.placed(bits.mask)
                    mask = little | int.from_bytes(big.to_bytes(message.length, "big"), "little")
                    scheme = scheme_of(option.scheme, where)
                    user.checksum = bits, guarded(scheme, mask, bits.length, message.frame_id, option.data_id)
