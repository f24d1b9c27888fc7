"""What a controller does on a fixed set of observations, as a digest: files that act alike count as one controller (guarantee G4).

    probe set     ROWS scenarios of the task, drawn with a seed that never changes; STEPS steps, moved by inputs drawn beforehand
    behaviour     SHA-256 of its answers, rounded to RESOLUTION of each input's bounds; the first 16 digits

The set is the same for every controller of a task and model. The count is told and nothing rests on it: all attempts share one budget,
whichever controllers they are of. A controller that knows the set can pass for another one, which gains it nothing.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from s2r_runtime.controllers.observing import View, whole
from s2r_runtime.files.canonical import digest_of

if TYPE_CHECKING:
    from collections.abc import Sequence

    from s2r_runtime.evidence.uncertain import Control
    from s2r_runtime.hookspecs import Task
    from s2r_runtime.models.composed import ComposedModel

SEED, ROWS, STEPS = 20261128, 64, 16
RESOLUTION = 1e-3
"""Of an input's bounds: far above what rounding in another order makes, far below what a scenario's outcome depends on."""


def behaviour(control: Control, task: Task, model: ComposedModel, bounds: Sequence[tuple[float, float]], view: View = whole) -> str:
    """16 hex digits. bounds: (lower, upper) of each input. view: what the controller is shown. Raises what the controller raises."""
    rng = np.random.default_rng(SEED)
    lower, upper = np.array(bounds).T
    scenario = task.draw(rng, ROWS)
    x, hidden = np.asfortranarray(scenario["start"]), model.at_rest(ROWS)
    answers = []
    for k in range(STEPS):
        u = control(x, view(x, task.view(scenario), first=k == 0))
        answers.append(np.rint(u / (RESOLUTION * np.maximum(np.abs(lower), np.abs(upper)))))
        stepped, hidden = model.step(x, rng.uniform(lower, upper, u.shape), hidden)
        x, scenario = np.asfortranarray(stepped), task.advance(scenario, rng)
    return digest_of((np.array(answers) + 0.0).tolist()).removeprefix("sha256:")[:16]  # + 0: no -0
