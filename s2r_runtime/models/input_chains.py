"""The inputs of all runs through chains of effects, each link worked out once.

A tracer asks for thousands of chains that differ in one number. What acts on an input depends on the effects that touch it, in their order,
and on the inputs that these read: so every link is known by its effect, its values and the links before it on those inputs, and what it
gave is kept. An effect on the speed is not worked out again because the steering's delay changed.

Many short runs are worked out side by side, (T, runs, nu); few or very unequal ones one after the other. Where rows do not last alike,
effects that know what to do with that get all runs end to end, with a long rest between them.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Sequence
from functools import cache, cached_property, partial

import numpy as np
from numpy.typing import NDArray

from s2r_runtime.models.composed import AppliedEffect, ComposedModel, delays_first

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Key = tuple[object, ...]
Columns = list[list[Array]]
"""Of each input, of each table: (T,) or (T, runs)."""

KEPT = 24_000_000
"""Bytes of results that are kept; the longest unused go first."""


REST_S = 1e4
"""Between runs that are laid end to end: no actuator remembers for so long."""

TINY = 1e-9
"""s that rows of a run that has none last, which nobody reads: no division by zero."""


class Inputs:
    """Held inputs of runs, (T_i, nu) each, in rows of dt; starts: of the runs, s. lasts: (T_i,) s, of each row, where they differ. parts:
    rows in a step of the model; where there are several, an input that changes within one has a mean there that nobody commanded. turned:
    (T_i / parts, nu) of each run, None or steps in whose last row an input changes, and is by its end what it is in the next one.
    """

    def __init__(
        self,
        inputs: Sequence[Array],
        dt: float,
        starts: Sequence[float],
        lasts: Sequence[Array] | None = None,
        parts: int = 1,
        turned: Sequence[Mask | None] = (),
    ) -> None:
        self._dt = dt
        self._mixed = parts > 1
        self._lasts = None if lasts is None else _end_to_end([e[:, None] for e in lasts], REST_S)[:, 0]
        begins = [] if lasts is None else [s + np.cumsum(e) - e for s, e in zip(starts, lasts, strict=True)]
        self._begins = _end_to_end([b[:, None] for b in begins], 0.0)[:, 0] if begins else np.zeros(0)
        self._kept: OrderedDict[Key, list[Array]] = OrderedDict()
        self._bytes = 0
        self._met: dict[int, object] = {}
        lengths = np.array([len(u) for u in inputs])
        self._rows: NDArray[np.int64] | None = None
        self._starts: list[float | Array] = [float(s) for s in starts]
        self._tables = [np.asarray(u, dtype=np.float64) for u in inputs]
        self._turned = tuple(turned)
        self._parts = parts
        self._lengths = lengths
        if len(inputs) > 3 and len(inputs) * lengths.max() < 2 * lengths.sum():
            table = _side_by_side(self._tables)
            self._tables, self._starts = [table], [np.array(starts, dtype=np.float64)]
            run, row = np.nonzero(np.arange(len(table)) < lengths[:, None])
            self._rows = row * len(inputs) + run  # of the table laid flat, in the order of runs laid end to end
            run, step = np.nonzero(np.arange(len(table) // parts) < (lengths // parts)[:, None])
            self._step_rows = step * len(inputs) + run
        self._each: list[float | Array] = [dt for _ in self._tables]
        """How long rows of each table last, s: all alike, or (T, 1), (T, runs, 1)."""
        if lasts is not None:
            columns = [np.asarray(e)[:, None] for e in lasts]
            self._each = [np.maximum(_side_by_side(columns), TINY)] if self._rows is not None else [*columns]

    def through(self, model: ComposedModel, chain: Sequence[AppliedEffect]) -> Array:
        """What acts after the chain, on average over each row, from rest: the runs laid end to end, (sum T_i, nu)."""
        now, _, links = self._follow(model, chain, set())
        return self._laid(("laid", *links), now)

    def with_ends(self, model: ComposedModel, chain: Sequence[AppliedEffect]) -> tuple[Array, Array]:
        """The same, and what acts at the end of each row. One and the same array, if no effect says anything of the ends."""
        now, last, links = self._followed(model, chain)
        mean = self._laid(("laid", *links), now)
        return mean, (mean if last is now else self._laid(("laid at the ends", *links), last))

    def over_steps(self, model: ComposedModel, chain: Sequence[AppliedEffect]) -> tuple[Array, Array]:
        """The same over the model's steps: on average over each, and at its end; the runs laid end to end, (sum T_i / parts, nu)."""
        if self._rows is None or self._parts == 1:
            mean, ends = self.with_ends(model, chain)
            if self._parts == 1:
                return mean, ends
            width = mean.shape[1]
            each = np.tile(np.eye(width) / self._parts, (self._parts, 1))
            return mean.reshape(-1, self._parts * width) @ each, ends[self._parts - 1 :: self._parts].copy()
        now, last, links = self._followed(model, chain)
        means = [self._step_means(("over steps", c, link), columns[0]) for c, (link, columns) in enumerate(zip(links, now, strict=True))]
        at_ends = [_in_order(columns[0][self._parts - 1 :: self._parts], self._step_rows) for columns in last]
        return np.stack(means, axis=1), np.stack(at_ends, axis=1)

    def _step_means(self, key: Key, column: Array) -> Array:
        """(sum T_i / parts,) of a column (T, runs)."""
        found = self._kept.get(key)
        if found is None:
            found = [_in_order(column.reshape(-1, self._parts, column.shape[1]).mean(axis=1), self._step_rows)]
            self._keep(key, found)
        else:
            self._kept.move_to_end(key)
        return found[0]

    def _asked_at_ends(self, model: ComposedModel, chain: Sequence[AppliedEffect]) -> set[int]:
        """Columns of which somebody asks what acts at the ends of rows: those that states are set to, and what these come from. A steering
        wheel sets none.
        """
        reached = getattr(model.nominal, "reached", {})
        if reached and self._given_at_ends is not self._tables:  # what is commanded there is another thing already
            return set(range(len(model.nominal.inputs)))
        found = {model.nominal.inputs.index(name) for name in reached.values()}
        before: set[int] = set()
        while len(before) < len(found) < len(model.nominal.inputs):
            before = set(found)
            for a in chain:
                touched = self._touched(a, model)
                if found.intersection(touched):
                    found.update(touched)
        return found

    def _followed(self, model: ComposedModel, chain: Sequence[AppliedEffect]) -> tuple[Columns, Columns, list[Key]]:
        """`_follow`, with what acts at the ends if some effect says something of them."""
        asked = self._asked_at_ends(model, chain)
        ends = any(a.says_ends and asked.intersection(self._touched(a, model)) for a in chain)
        return self._follow(model, chain, asked if ends else set())

    def _follow(self, model: ComposedModel, chain: Sequence[AppliedEffect], ends: set[int]) -> tuple[Columns, Columns, list[Key]]:
        """Columns on average and at the ends of rows (of those inputs only, the same ones if there are none), and the last link on each
        input.
        """
        nominal = model.nominal
        who: Key = (self._number(nominal.shared), *sorted(nominal.parameters.items()))
        links: list[Key] = [(who, name) for name in nominal.inputs]
        now = self._given
        last = now if not ends or self._given_at_ends is self._tables else _apart(self._given_at_ends)
        for a in delays_first(nominal, chain, lambda link: link):
            touched = self._touched(a, model)
            key: Key = (self._number(a.effect), a.channel, values_key(a), *(links[c] for c in touched))
            found = self._kept.get(key)
            if found is None:
                found = self._keep_columns(key, self._apply(a, _whole(now), model), touched)
            else:
                self._kept.move_to_end(key)
            acted = self._with(now, touched, found)
            if ends.intersection(touched):
                last = self._ends(key, a, now, acted, last, touched, model)
            elif last is now:
                last = acted
            now = acted
            for c in touched:
                links[c] = key
        return now, last, links

    def _ends(
        self, key: Key, a: AppliedEffect, given: Columns, acted: Columns, last: Columns, touched: list[int], model: ComposedModel
    ) -> Columns:
        """At the ends of rows after one more link, from what it was given, what acted, and what it was given at the ends."""
        if last is given and not a.says_ends:
            return acted
        known = ("ends", *key)
        found = self._kept.get(known)
        if found is None:
            whole = _whole(given)
            at_ends = whole if last is given else _whole(last)
            again = cache(lambda: self._apply(a, at_ends, model))
            when = self._when if getattr(a.effect, "timed", False) else [None for _ in whole]
            after = [
                a.ends((u, acting, end), t, partial(_one, again, i), model.nominal, dt, mixed=self._mixed)
                for i, (u, acting, end, dt, t) in enumerate(zip(whole, _whole(acted), at_ends, self._each, when, strict=True))
            ]
            found = self._keep_columns(known, after, touched)
        else:
            self._kept.move_to_end(known)
        return self._with(last, touched, found)

    def _with(self, columns: Columns, touched: list[int], found: list[Array]) -> Columns:
        """Some of the columns changed. found: of each of them, of each table."""
        changed, count = [*columns], len(self._tables)
        for i, c in enumerate(touched):
            changed[c] = found[i * count : (i + 1) * count]
        return changed

    def _keep_columns(self, key: Key, tables: list[Array], touched: list[int]) -> list[Array]:
        """Those of tables, kept: of each of them, of each table."""
        found = [np.array(table[..., c]) for c in touched for table in tables]
        self._keep(key, found)
        return found

    @cached_property
    def _given(self) -> Columns:
        """What is commanded."""
        return _apart(self._tables)

    @cached_property
    def _given_at_ends(self) -> list[Array]:
        """What is commanded at the ends of rows: `_tables` themselves, if that is what is commanded on average."""
        if all(mask is None for mask in self._turned):
            return self._tables
        runs = [u.copy() for u in self._split(self._tables)]
        for u, mask in zip(runs, self._turned, strict=True):
            if mask is not None:
                step, column = np.nonzero(mask)
                row = (step + 1) * self._parts - 1
                within = row < len(u) - 1
                u[row[within], column[within]] = u[row[within] + 1, column[within]]
        return runs if self._rows is None else [_side_by_side(runs)]

    @cached_property
    def _when(self) -> list[Array]:
        """When each row of each table begins, s: (T, 1) or (T, runs, 1)."""
        found = []
        for table, start, dt in zip(self._tables, self._starts, self._each, strict=True):
            lasts = np.broadcast_to(dt, (*table.shape[:-1], 1))
            found.append(np.cumsum(lasts, axis=0) - lasts + (start[:, None] if isinstance(start, np.ndarray) else start))
        return found

    def _laid(self, key: Key, columns: Columns) -> Array:
        """The runs laid end to end."""
        found = self._kept.get(key)
        if found is None:
            tables = _whole(columns)
            one_by_one = tables[0] if len(tables) == 1 else np.concatenate(tables)
            laid = one_by_one if self._rows is None else _in_order(tables[0], self._rows)
            found = [laid.view()]
            found[0].flags.writeable = False  # it is handed out again
            self._keep(key, found)
        else:
            self._kept.move_to_end(key)
        return found[0]

    def _touched(self, a: AppliedEffect, model: ComposedModel) -> list[int]:
        """Columns that the effect changes or reads."""
        names = model.nominal.inputs
        if a.channel not in names:
            return list(range(len(names)))
        reads = getattr(a.effect, "reads", None)
        also = reads(model.nominal, a.channel) if reads else ()
        return [i for i, name in enumerate(names) if name == a.channel or name in also]

    def _apply(self, a: AppliedEffect, tables: list[Array], model: ComposedModel) -> list[Array]:
        """What acts."""
        if self._lasts is not None and getattr(a.effect, "uneven", False):
            given = _end_to_end(self._split(tables), 0.0)
            also = {"start": self._begins} if getattr(a.effect, "timed", False) else self._also(a)
            return self._tabled(a.effect.input_sequence(given, model.nominal, a.channel, self._lasts, a.p, **also))  # type: ignore[arg-type]
        if self._rows is None or getattr(a.effect, "side_by_side", False):
            return [self._over_time(a, u, model, start) for u, start in zip(tables, self._starts, strict=True)]
        z, done = a.effect.hidden(tables[0].shape[1], model.nominal, a.channel, self._dt, a.p), []
        if getattr(a.effect, "timed", False):
            z[:, 0] = self._starts[0]
        for u in tables[0]:
            acting_now, z = a.effect.input_step(u, z, model.nominal, a.channel, self._dt, a.p)
            done.append(acting_now)
        return [np.stack(done)]

    def _split(self, tables: list[Array]) -> list[Array]:
        """One (T_i, nu) a run."""
        if self._rows is None:
            return tables
        return [tables[0][:n, i] for i, n in enumerate(self._lengths.tolist())]

    def _tabled(self, laid: Array) -> list[Array]:
        """Runs with a row between them, end to end, as this has them."""
        begin = np.cumsum(self._lengths + 1) - self._lengths - 1
        runs = [laid[b : b + n] for b, n in zip(begin.tolist(), self._lengths.tolist(), strict=True)]
        return runs if self._rows is None else [_side_by_side(runs)]

    def _over_time(self, a: AppliedEffect, u: Array, model: ComposedModel, start: float | Array) -> Array:
        """`input_sequence`; an effect that depends on time is told when the first row is."""
        if getattr(a.effect, "timed", False):
            return a.effect.input_sequence(u, model.nominal, a.channel, self._dt, a.p, start=start)  # type: ignore[call-arg]
        return a.effect.input_sequence(u, model.nominal, a.channel, self._dt, a.p, **self._also(a))

    def _also(self, a: AppliedEffect) -> dict[str, bool]:
        """What an effect is told that knows what to make of rows within which an input changes."""
        return {"mixed": True} if self._mixed and getattr(a.effect, "takes_mixed", False) else {}

    def _number(self, thing: object) -> int:
        """Of a model or an effect of others, which need not be hashable. It is kept, so that no other object gets its number."""
        self._met[id(thing)] = thing
        return id(thing)

    def _keep(self, key: Key, found: list[Array]) -> None:
        self._kept[key] = found
        self._bytes += sum(columns.nbytes for columns in found)
        while self._bytes > KEPT and len(self._kept) > 1:
            _, gone = self._kept.popitem(last=False)
            self._bytes -= sum(columns.nbytes for columns in gone)


def _side_by_side(runs: Sequence[Array]) -> Array:
    """(T_i, nu) each -> (T, runs, nu). After its end a run goes on as it was: beside zeros its last row might look like a mean of what was
    held before and of them.
    """
    table = np.zeros((max(len(u) for u in runs), len(runs), runs[0].shape[1]))
    for i, u in enumerate(runs):
        table[: len(u), i] = u
        if len(u):
            table[len(u) :, i] = u[-1]
    return table


def _in_order(table: Array, rows: NDArray[np.int64]) -> Array:
    """(T, runs, ...) -> the runs laid end to end. rows: of the table laid flat."""
    if len(rows) == table.shape[0] * table.shape[1]:  # all of one length
        return np.swapaxes(table, 0, 1).reshape(-1, *table.shape[2:])
    return np.asarray(table.reshape(-1, *table.shape[2:])[rows])


def _end_to_end(runs: Sequence[Array], between: float) -> Array:
    """(T_i, c) each -> one after the other, with a row of this between two."""
    rest = np.full((1, runs[0].shape[1]), between)
    return np.concatenate([part for run in runs for part in (run, rest)][:-1])


def _one(tables: Callable[[], list[Array]], i: int) -> Array:
    return tables()[i]


def _apart(tables: list[Array]) -> Columns:
    return [[np.array(table[..., c]) for table in tables] for c in range(tables[0].shape[-1])]


def _whole(columns: Columns) -> list[Array]:
    """Tables (T, nu) or (T, runs, nu)."""
    tables = [np.empty((*first.shape, len(columns))) for first in columns[0]]
    for c, column in enumerate(columns):
        for table, values in zip(tables, column, strict=True):
            table[..., c] = values
    return tables


def values_key(a: AppliedEffect) -> Key:
    """Parameter values as something that can be looked up."""
    return tuple((name, str(value) if isinstance(value, list) else value) for name, value in sorted(a.p.items()))
