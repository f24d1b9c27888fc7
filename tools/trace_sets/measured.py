"""The measured recordings that the tracer is held to, each with its model and its options (tests/test_trace_measured.py has the figures).

K. Leung et al., The UTIAS multi-robot cooperative localization and mapping dataset, IJRR 30(8), 2011. A. Janot, M. Gautier, M. Brunot,
Data set and reference models of EMPS, 2019. N. Kochdumper, S. Bak, Conformant synthesis for Koopman operator linearized control
systems, 2022. D. Baril et al., DRIVE: data-driven robot input vector exploration, ICRA 2024. The data are not part of this project.
"""

from __future__ import annotations

import csv
import gzip
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from s2r_runtime.modelspec import ModelSpec

if TYPE_CHECKING:
    from s2r_runtime.trace.reporting.result import TraceResult


class Measured(NamedTuple):
    """fit, test: files in the folder. options: of `trace`. third: held out is every third step of commands of `fit`, from its wheels."""

    spec: ModelSpec
    fit: str
    test: str = ""
    options: dict[str, Any] = {}
    third: bool = False


def _emps(dt: float) -> Measured:
    return Measured(ModelSpec("joint", dt, {"mass": 95.1}), "emps_estimation.csv.gz", "emps_pulses.csv.gz")


HUSKY = ModelSpec("differential_drive", 0.05, {"wheel_radius": 0.165, "track": 0.55})
RECORDINGS = {
    "mrclam": Measured(ModelSpec("unicycle", 0.1), "mrclam_ds4_robot3.csv.gz"),
    "emps": _emps(0.01),
    "emps_own_step": _emps(0.001),
    "f1tenth": Measured(ModelSpec("bicycle", 0.025, {"wheel_base": 0.33}), "f1tenth.csv.gz", options={"horizon": 3.0}),
    "husky": Measured(HUSKY, "husky_drive.csv.gz", options={"horizon": 2.0}, third=True),
    "rover": Measured(ModelSpec("unicycle", 0.1), "rover_sitl.tlog.gz"),
}


def trace_measured(one: Measured, folder: Path, scratch: Path) -> TraceResult:
    """What the tracer answers on it. folder: of the recordings. scratch: for files that are made of them."""
    from s2r_runtime.models.composed import compose
    from s2r_runtime.trace.pipeline import load_dataset, trace

    model = compose(one.spec)
    fit, test = folder / one.fit, folder / one.test if one.test else None
    if one.third:
        fit, test = (_from_wheels(folder / one.fit, scratch / f"{name}.csv", held_out=name == "test") for name in ("fit", "test"))
    data = load_dataset(fit, model)
    return trace(data, model, test=load_dataset(test, model) if test else None, **one.options)


def _from_wheels(source: Path, to: Path, *, held_out: bool) -> Path:
    """The windows of every third 6 s step, or those of the others, with the wheels' measured speeds for inputs."""
    with gzip.open(source, "rt") as read, to.open("w") as write:
        out = csv.writer(write)
        out.writerow(["segment", "t", "x", "y", "theta", "cmd_left", "cmd_right"])
        for row in csv.DictReader(read):
            if (int(row["segment"]) // 3 % 3 == 2) == held_out:
                out.writerow([row[name] for name in ("segment", "t", "x", "y", "theta", "wheel_left", "wheel_right")])
    return to
