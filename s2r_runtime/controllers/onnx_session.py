"""Runs a learned policy in the controller's process: observations -> scaling -> network -> scaling -> limits.

    theta   {name: (n, history, width)} from `observing`            u (n, nu), inside the limits of the settings

One thread, one fixed order of operations, and blocks of one fixed size: the k-th row of a batch of hundreds goes through the same kernels
as the one row on the robot. On one processor and one version of onnxruntime the answers are equal to the last bit. Another processor
may have other kernels, which add in another order: there the last digits of float32 may differ.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from s2r_runtime.controllers.code import Malformed, Raised
from s2r_runtime.controllers.policy import settings_of
from s2r_runtime.errors import ConfigError, one_line
from s2r_runtime.hookspecs import Scenario

if TYPE_CHECKING:
    from s2r_runtime.controllers.file import ControllerFile

Array = NDArray[np.float64]

BLOCK = 16
"""Rows at a time, unless the network fixes its own number. Enough for vector units; on the robot 15 of them are copies."""
_SILENT = 4
"""onnxruntime's severity for messages: fatal ones only. The rest comes as exceptions."""
_TYPES: dict[str, Any] = {"tensor(float)": np.float32, "tensor(double)": np.float64}


class Policy:
    """`control(x, theta, parameters)` of an ONNX file."""

    def __init__(self, file: ControllerFile, name: str, nu: int | None) -> None:
        """Raises ConfigError for a network that onnxruntime can't load, or with inputs and outputs of another form."""
        self._settings, self._name = settings_of(file.entry, file.parameters), name
        self._session = _session(file.source, name)
        inputs, outputs = self._session.get_inputs(), self._session.get_outputs()
        if len(inputs) != 1 or len(outputs) != 1:
            raise ConfigError(
                f"{name}: has {len(inputs)} inputs and {len(outputs)} outputs, must have one of each: observations and commands"
            )
        self._input, self._output = inputs[0], outputs[0]
        for one in (self._input, self._output):
            if one.type not in _TYPES:
                raise ConfigError(f"{name}: {one.name} is a {one.type}, must be one of: {', '.join(_TYPES)}")
        self._nu = len(self._settings.outputs)
        if nu is not None and nu != self._nu:
            raise ConfigError(f"{name}: its settings have {self._nu} outputs, the robot has {nu} inputs")
        shape = self._input.shape
        self._rank = len(shape)
        fixed = shape[0] if self._rank in {2, 3} else None
        self._block = fixed if isinstance(fixed, int) and fixed > 0 else BLOCK
        self._lower, self._upper, self._offset, self._scale = (
            np.array([getattr(output, what) for output in self._settings.outputs]) for what in ("lower", "upper", "offset", "scale")
        )

    def __call__(self, x: Array, theta: Scenario, _parameters: Any) -> Array:
        """u (n, nu). Raises ConfigError where observations and network do not fit, Raised for what onnxruntime reports,
        Malformed for outputs that are not finite.
        """
        n = len(x)
        z = np.concatenate([_scaled(theta[one.name], one.offset, one.scale, one.clip) for one in self._settings.observations], axis=2)
        z = self._fitted(z).astype(_TYPES[self._input.type])
        y = np.concatenate([self._run(z[first : first + self._block]) for first in range(0, n, self._block)])
        if not np.isfinite(y).all():
            row, column = np.argwhere(~np.isfinite(y))[0]
            output = self._settings.outputs[column].name
            raise Malformed(f"{self._name}: the network's output for {output} is {y[row, column]} (row {row}), must be finite")
        u: Array = np.clip(self._offset + self._scale * y, self._lower, self._upper)
        return u

    def _fitted(self, z: Array) -> Array:
        """(n, history, width) in the form of the network's input. Raises ConfigError if it has another."""
        n, history, width = z.shape
        shape: list[Any] = self._input.shape
        wanted = {2: (history * width,), 3: (history, width)}.get(self._rank)
        if wanted is None or any(isinstance(has, int) and has != one for has, one in zip(shape[1:], wanted, strict=True)):
            here = f"(n, {history}, {width}) or (n, {history * width})" if history > 1 else f"(n, {width})"
            raise ConfigError(
                f"{self._name}: its input has shape ({', '.join(map(str, shape))}), must be {here}: "
                f"{width} observed numbers, {history} of each"
            )
        return z.reshape(n, *wanted)

    def _run(self, block: NDArray[Any]) -> Array:
        """(rows, nu) of at most a block's rows, which is filled up with copies of the last one."""
        rows = len(block)
        if rows < self._block:
            block = np.concatenate([block, np.repeat(block[-1:], self._block - rows, axis=0)])
        try:
            y = np.asarray(self._session.run([self._output.name], {self._input.name: block})[0])
        except Exception as error:  # noqa: BLE001 - onnxruntime's exceptions have no base of their own
            raise Raised(f"{self._name}: onnxruntime: {one_line(str(error))}") from None
        if y.shape != (self._block, self._nu):
            raise ConfigError(f"{self._name}: its output has shape {y.shape}, must be ({self._block}, {self._nu}): one row for each row")
        return y[:rows].astype(np.float64)


def _session(source: bytes, name: str) -> Any:
    try:
        import onnxruntime
    except ImportError:
        raise ConfigError(f"{name}: needs onnxruntime: pip install 's2r-runtime[onnx]'") from None
    onnxruntime.set_default_logger_severity(_SILENT)
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.execution_mode = onnxruntime.ExecutionMode.ORT_SEQUENTIAL
    options.graph_optimization_level = onnxruntime.GraphOptimizationLevel.ORT_ENABLE_BASIC  # none that depends on the processor
    options.use_deterministic_compute = True
    options.enable_cpu_mem_arena = options.enable_mem_pattern = False
    options.log_severity_level = _SILENT
    try:
        return onnxruntime.InferenceSession(source, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # noqa: BLE001 - as above
        raise ConfigError(f"{name}: onnxruntime cannot load it: {one_line(str(error))}") from None


def _scaled(value: Array, offset: float | tuple[float, ...], scale: float | tuple[float, ...], clip: float | None) -> Array:
    z: Array = (value - np.asarray(offset)) / np.asarray(scale)
    return z if clip is None else np.clip(z, -clip, clip)
