"""Small learned policies, made for tests."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

EXAMPLE = Path(__file__).parents[2] / "examples" / "learned"


def tables(
    observations: Sequence[str] = ("x", "y", "theta"),
    outputs: Sequence[str] = ("v", "w"),
    top: str = "",
    each: str = "",
    limits: str = "lower = -0.2\nupper = 0.2",
) -> str:
    """Text of a policy's settings."""
    text = f"{top}\n"
    text += "".join(f'[[observations]]\nname = "{name}"\n{each}\n' for name in observations)
    return text + "".join(f'[[outputs]]\nname = "{name}"\n{limits}\n' for name in outputs)


def linear(
    weights: Any, *, shape: Sequence[int | str] | None = None, rows: int | str = "n", kind: int = TensorProto.FLOAT, **more: Any
) -> Any:
    """y = z W as an ONNX model. weights: (k, nu). shape: of the input, if another. more: `op`, in place of MatMul, with its `domain`."""
    w = np.array(weights, dtype=helper.tensor_dtype_to_np_dtype(kind))
    node = helper.make_node(more.get("op", "MatMul"), ["z", "w"], ["y"], domain=more.get("domain", ""))
    graph = helper.make_graph(
        [node],
        "linear",
        [helper.make_tensor_value_info("z", kind, shape or [rows, w.shape[0]])],
        [helper.make_tensor_value_info("y", kind, more.get("out", [rows, w.shape[1]]))],
        [numpy_helper.from_array(w, "w")],
    )
    return helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=9)


def write(folder: Path, model: Any, settings: str | None = None, name: str = "policy") -> Path:
    """Both files of a policy; the path of the `.onnx`."""
    path = folder / f"{name}.onnx"
    path.write_bytes(model if isinstance(model, bytes) else model.SerializeToString(deterministic=True))
    path.with_suffix(".toml").write_text(tables() if settings is None else settings)
    return path


def external(folder: Path) -> Path:
    """A policy whose weights are in a file of their own."""
    path = folder / "policy.onnx"
    model = linear(np.ones((3, 2)))
    onnx.save(model, path, save_as_external_data=True, location="weights.bin", size_threshold=0)
    path.with_suffix(".toml").write_text(tables())
    return path
