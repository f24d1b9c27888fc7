"""The same test for several seeds or cases: the first ones in `make test`, all of them in `make test-all`."""

from collections.abc import Iterable

import pytest


def first(soon: int, cases: Iterable[object]) -> list[object]:
    """The cases, of which those after the first `soon` are `slow`: they show much the same as the others, at the same price each."""
    return [case if i < soon else pytest.param(case, marks=pytest.mark.slow) for i, case in enumerate(cases)]
