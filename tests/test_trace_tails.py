"""A spike is a fault where nothing else is wild, and the largest of a few wild rows where some are."""

import numpy as np
import pytest

from s2r_runtime.models.composed import compose
from s2r_runtime.modelspec import ModelSpec
from s2r_runtime.trace.data.dataset import from_arrays
from s2r_runtime.trace.sensor_faults.detect import check

pytestmark = pytest.mark.slow

NOISE = np.array([0.001, 0.01])


@pytest.mark.parametrize(
    ("others", "kinds"),
    [((), ["spike"]), ((6.0, -8.0), ["spike"]), ((5.0, 7.0, -8.0, 9.0, -11.0), []), ((30.0, -35.0, 28.0), ["spike"] * 4)],
)
def test_the_largest_of_a_few_wild_rows_is_no_fault(others, kinds):
    """Of 1500 rows too few for the quantiles of the noise, up to 40 standard deviations off."""
    model = compose(ModelSpec("joint", 0.02, {"mass": 1.0}))
    rng = np.random.default_rng(2)
    u = np.repeat(rng.uniform(-0.5, 0.5, (75, 1)), 20, axis=0)
    x, hidden, rows = np.zeros((1, 2)), model.at_rest(1), [np.zeros(2)]
    for k in range(len(u)):
        x, hidden = model.step(x, u[k : k + 1], hidden)
        rows.append(x[0])
    y = np.array(rows) + rng.normal(size=(len(rows), 2)) * NOISE
    for at, size in zip((100, 310, 700, 905, 1200, 1350), (40.0, *others), strict=False):
        y[at, 1] = rows[at][1] + size * NOISE[1]
    assert [f.kind for f in check(model, from_arrays(model, [(y, u)])).faults] == kinds
