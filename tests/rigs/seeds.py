"""The same test for several seeds or cases: the first ones in `make test`, all of them in `make test-long`."""

from collections.abc import Iterable

import pytest


def first(soon: int, cases: Iterable[object]) -> list[object]:
    """The cases, of which those after the first so many are `long`: they show much the same as the others, at the same price each."""
    return [case if i < soon else pytest.param(case, marks=pytest.mark.long) for i, case in enumerate(cases)]
