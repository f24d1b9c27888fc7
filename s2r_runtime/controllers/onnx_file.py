"""What an ONNX file holds, as far as it is looked at before anything runs: read from its protobuf bytes, without the onnx package.

    ModelProto.graph = 7, opset_import = 8, training_info = 20, functions = 25
    GraphProto.node = 1, initializer = 5, sparse_initializer = 15
    FunctionProto.node = 7, attribute_proto = 11                SparseTensorProto.values = 1, indices = 2
    NodeProto.attribute = 5                                     AttributeProto.t = 5, g = 6, tensors = 10, graphs = 11, sparse = 22, 23
    TensorProto.external_data = 13, data_location = 14 (1: EXTERNAL)

The numbers are those of onnx.proto3 (ONNX 1.16), which never change. A tensor whose values are in another file is refused: the digest
would not cover them.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from s2r_runtime.errors import ConfigError

_VARINT, _FIXED64, _BYTES, _FIXED32 = 0, 1, 2, 5  # wire types of protobuf
_GRAPH, _OPSET = 7, 8  # of ModelProto: every model has both
_EXTERNAL_DATA, _DATA_LOCATION = 13, 14
_DEPTH_MAX = 32
"""Of graphs in nodes of graphs."""

# Message type -> {number of a field: the type of the messages in it}. Only what leads to a tensor.
_LEADS: dict[str, dict[int, str]] = {
    "model": {7: "graph", 20: "training", 25: "function"},
    "training": {1: "graph", 2: "graph"},
    "graph": {1: "node", 5: "tensor", 15: "sparse"},
    "function": {7: "node", 11: "attribute"},
    "node": {5: "attribute"},
    "attribute": {5: "tensor", 6: "graph", 10: "tensor", 11: "graph", 22: "sparse", 23: "sparse"},
    "sparse": {1: "tensor", 2: "tensor"},
    "tensor": {},
}


def check_onnx(data: bytes, path: Path) -> None:
    """Raises ConfigError for bytes that are no ONNX model, and for one whose tensors are in other files."""
    try:
        found = {number for number, _ in _fields(memoryview(data))}
        if not {_GRAPH, _OPSET} <= found:
            raise ValueError("it has no graph and operator set")
        external = _external(memoryview(data), "model", 0)
    except ValueError as error:
        raise ConfigError(f"{path}: is no ONNX model: {error}") from None
    if external:
        raise ConfigError(
            f"{path}: a tensor's values are in another file, which the digest would not cover; save the model in one file "
            "(onnx.save without save_as_external_data)"
        )


def _external(message: memoryview, kind: str, depth: int) -> bool:
    """Whether a tensor in it refers to another file."""
    if depth > _DEPTH_MAX:
        raise ValueError(f"nested more than {_DEPTH_MAX} levels deep")
    leads = _LEADS[kind]
    for number, value in _fields(message):
        if kind == "tensor" and (number == _EXTERNAL_DATA or (number == _DATA_LOCATION and value == 1)):
            return True
        if number in leads:
            if not isinstance(value, memoryview):
                raise ValueError(f"field {number} of a {kind} is no message")
            if _external(value, leads[number], depth + 1):
                return True
    return False


def _fields(message: memoryview) -> Iterator[tuple[int, int | memoryview]]:
    """(number, value) of each field of a message. Raises ValueError where it is no protobuf."""
    at, end = 0, len(message)
    while at < end:
        key, at = _varint(message, at)
        number, wire = key >> 3, key & 7
        if wire == _VARINT:
            value, at = _varint(message, at)
            yield number, value
            continue
        if wire == _BYTES:
            length, at = _varint(message, at)
        elif wire in {_FIXED64, _FIXED32}:
            length = 8 if wire == _FIXED64 else 4
        else:
            raise ValueError(f"byte {at} begins no protobuf field")
        if number == 0 or at + length > end:
            raise ValueError("it is cut short, or no protobuf")
        yield number, message[at : at + length]
        at += length


def _varint(message: memoryview, at: int) -> tuple[int, int]:
    """A number of 7 bits a byte, least significant first, and where the next field begins."""
    value = 0
    for shift in range(0, 70, 7):
        if at >= len(message):
            raise ValueError("it is cut short, or no protobuf")
        byte = message[at]
        at += 1
        value |= (byte & 0x7F) << shift
        if byte < 0x80:
            return value, at
    raise ValueError("it is no protobuf")
