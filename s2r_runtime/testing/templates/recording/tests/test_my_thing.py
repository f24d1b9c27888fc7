"""What the log says is what is read, and what is no log is refused with its line."""

import numpy as np
import pytest
from my_thing.logs import read

from s2r_runtime.errors import RecordingError

STATES, INPUTS = ("x", "y", "theta"), ("v", "w")


def test_readings_stand_at_their_own_times_and_the_rest_is_nan(tmp_path):
    path = tmp_path / "a.my_thing"
    path.write_text("# a log\n1.0 x 0.5\n1.1 v 0.2\n1.2 theta 0.1\n1.2 battery 12.1\n")
    (((t_x, x), (t_u, u)),) = read(path, STATES, INPUTS, {})
    assert t_x.tolist() == [1.0, 1.2]
    assert t_u.tolist() == [1.1]
    np.testing.assert_array_equal(x, [[0.5, np.nan, np.nan], [np.nan, np.nan, 0.1]])
    np.testing.assert_array_equal(u, [[0.2, np.nan]])


@pytest.mark.parametrize("line", ["hello", "1.0 x", "1.0 x nan", "now x 1"])
def test_what_is_no_reading_is_named_with_its_line(tmp_path, line):
    path = tmp_path / "a.my_thing"
    path.write_text(f"1.0 x 0.5\n{line}\n")
    with pytest.raises(RecordingError, match="line 2"):
        read(path, STATES, INPUTS, {})
