"""The channels of a log: one for each message type, named after its family and tag.

    frame/in  frame/out      bytes as a transport received and sent them
    event/<tag>              what went into the core
    out/<tag>                what came out of it
    log/<tag>                what the log says about itself

JSON with a JSON Schema that Foxglove opens: the root is an object, nothing is a `$ref`, and what it cannot draw (nested
arrays, unions) is left out of the schema, not out of the message.
"""

from __future__ import annotations

import inspect
from functools import cache
from typing import Any, Literal, get_args

import msgspec
from msgspec import inspect as types

from s2r_runtime import messages
from s2r_runtime.messages import Frame, Struct

FRAME_IN, FRAME_OUT, CHAIN, UNRECORDED, DELETED = "frame/in", "frame/out", "log/chain", "log/unrecorded", "log/deleted"


class Seal(Struct, frozen=True, tag="chain"):
    """Closes a chunk: all before it is what `head` says (see `chain`).

    `count`: messages of the run before this one, which is its index. `file`: SHA-256 of the file up to this block.
    `end`: why nothing follows in this file. `signature`: Ed25519 over the other fields; empty in an unsigned log.
    """

    t_ns: int
    count: int
    head: bytes
    file: bytes
    end: Literal["", "rotated", "closed"] = ""
    signature: bytes = b""


class Unrecorded(Struct, frozen=True, tag="unrecorded"):
    """`count` messages after this point were not recorded; nothing but the final seal follows."""

    t_ns: int
    count: int
    reason: str


class LogDeleted(Struct, frozen=True, tag="deleted"):
    """The log of an earlier run was deleted, because the profile keeps no more. `head`: of its chain, as far as it was known; hex."""

    t_ns: int
    run: str
    files: int
    bytes: int
    head: str
    reason: str


def _tag(kind: type[msgspec.Struct]) -> str:
    return str(kind.__struct_config__.tag)


def _table() -> dict[str, type[Struct]]:
    table: dict[str, type[Struct]] = {FRAME_IN: Frame, FRAME_OUT: Frame}
    table.update((f"event/{_tag(kind)}", kind) for kind in get_args(messages.Event))
    table.update((f"out/{_tag(kind)}", kind) for kind in get_args(messages.Output))
    table.update((f"log/{_tag(kind)}", kind) for kind in (Seal, Unrecorded, LogDeleted))
    return table | {name: table.pop(name) for name in LATER}


LATER = (
    "event/observation_refused",
    "event/answer_late",
    "event/seed_drawn",
    "out/draw_seed",
    "event/episode_scored",
    "out/episode_counted",
)
"""Channels that came after others had their numbers, in the order in which they came."""

CHANNELS: dict[str, type[Struct]] = _table()
"""Name -> type of its messages. The position is the channel's number (from 1) in files of this version."""

NUMBERS: dict[str, int] = {name: number for number, name in enumerate(CHANNELS, 1)}

BY_TYPE: dict[type[Struct], int] = {kind: NUMBERS[name] for name, kind in CHANNELS.items() if kind is not Frame}
"""Type -> channel number, but for frames, whose direction decides."""


@cache
def decoder(name: str) -> msgspec.json.Decoder[Struct]:
    """Decoder of a channel's messages. Raises KeyError for a channel that this version does not know."""
    return msgspec.json.Decoder(CHANNELS[name])


def schema(kind: type[Struct]) -> dict[str, Any]:
    """The JSON Schema of a message type, all in one piece (see the module's docstring)."""
    found = _schema(types.type_info(kind))
    if found is None:
        raise TypeError(f"{kind.__name__} is no struct")
    return {"title": kind.__name__, "description": inspect.getdoc(kind) or "", **found}


def _schema(kind: types.Type) -> dict[str, Any] | None:
    """None for what Foxglove refuses: it would refuse the whole channel."""
    match kind:
        case types.StructType():
            properties: dict[str, Any] = {kind.tag_field: {"type": "string", "enum": [kind.tag]}} if kind.tag_field else {}
            properties.update((field.encode_name, part) for field in kind.fields if (part := _schema(field.type)) is not None)
            return {"type": "object", "properties": properties}
        case types.DictType() | types.AnyType():
            return {"type": "object", "properties": {}}
        case types.VarTupleType() | types.ListType():
            items = _schema(kind.item_type)
            return None if items is None or items["type"] == "array" else {"type": "array", "items": items}
        case types.UnionType():
            known = [one for one in kind.types if not isinstance(one, types.NoneType)]
            return _schema(known[0]) if len(known) == 1 else None
        case types.LiteralType():
            return {"type": "string", "enum": list(kind.values)}
        case types.BytesType():
            return {"type": "string", "contentEncoding": "base64"}
    plain = {types.BoolType: "boolean", types.IntType: "integer", types.FloatType: "number", types.StrType: "string"}
    name = plain.get(type(kind))
    return None if name is None else {"type": name}
