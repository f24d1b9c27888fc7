"""A recording with its steps cut into fewer parts: to look by, and to see what cutting does."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from s2r_runtime.trace.data.dataset import Dataset, Run

FEW = 3
"""Parts of a step that are left at most to look by."""


def coarser(data: Dataset, by: int) -> Dataset:
    """The same with inputs as means over so many parts."""
    return replace(data, runs=tuple(_joined(run, data.substeps, by) for run in data.runs), substeps=data.substeps // by)


def coarse(data: Dataset) -> Dataset:
    """The same in FEW parts of a step or less; itself, if that is not possible."""
    by = next((by for by in range(2, data.substeps + 1) if data.substeps % by == 0 and data.substeps // by <= FEW), 1)
    return data if by == 1 or data.in_parts else coarser(data, by)


def _joined(run: Run, substeps: int, by: int) -> Run:
    """What changes within the last parts of a step counts as over by its end if the next ones hold (`streams.turned`)."""
    u = run.u.reshape(-1, substeps, run.u.shape[1])
    last = (u[:-1, -by] != u[:-1, -1]) & (u[:-1, -1] == u[1:, 0])
    changed = last if run.turned is None else last | run.turned[:-1]
    turned = np.append(changed & (u[1:, 0] == u[1:, by - 1]), np.zeros((1, u.shape[2]), dtype=bool), axis=0)
    return replace(run, u=run.u.reshape(-1, by, run.u.shape[1]).mean(axis=1), turned=turned)
