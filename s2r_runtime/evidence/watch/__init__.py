"""Sequential watch on the stream of discrepancies while a controller drives (guarantee G5): three tests, in constant memory each.

`exceedance`: is the gap exceeded too often? Its alarm revokes. `change`: has that changed just now? `exchangeability`: are they of one law?
Both give notice. `stream`: the discrepancies themselves. All follow from what is logged, so an audit repeats them to the bit.
"""

from s2r_runtime.evidence.watch.change import ChangeDetector
from s2r_runtime.evidence.watch.exceedance import GRID, LARGEST, EProcess
from s2r_runtime.evidence.watch.exchangeability import ConformalTest, tie_break
from s2r_runtime.evidence.watch.stream import Stream, measurement_fault

__all__ = ["GRID", "LARGEST", "ChangeDetector", "ConformalTest", "EProcess", "Stream", "measurement_fault", "tie_break"]
