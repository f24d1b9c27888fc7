"""Which rows of a recording did a fit see? A sketch of measured states, stored with the model that was fitted to them (guarantee G6).

A row is one measured state (nx,), angles as points of a circle. It is hashed in two grids, half a cell apart; a cell is CELL of a column's
spread. Rows that differ by far less than a cell (rounding, noise of arithmetic) share one of the two, whatever the order, the stamps, and
what else is in the table. A sketch stores the KEPT lowest hashes of each grid: all of a recording up to that size, else a random subset of
its rows (bottom-k sampling; Cohen and Kaplan 2007). Of m seen rows out of N it finds two or more with probability 1 - (1 + a) exp(-a) at
least, a = m KEPT / N.

Null hypothesis: a fresh recording. A row of it falls into a cell that the fit saw with probability `chance`, estimated from the fit: of
visits to ten times larger cells, the share that another visit shares, a tenth of it. Of a coarse sensor, whose steps are all larger than a
cell, it is the share of visits that come again, from above. Refused: MIN_SEEN different rows, and more than a Bin(n, SAFETY chance)
exceeds with probability ALPHA.

As text a sketch is the lists of hashes, without their lowest bits, as Elias-Fano codes (Elias 1974): of n sorted numbers below U = 2^l n,
l low bits each, and a bitmap of the rest, n (l + 2) bits or so. A hash that no row of the fit has is found in such a list with probability
n / U = 2^-FALSE_BITS at most; both grids' are added to `chance`. The sketches of a model that was fitted often have TEXT_MAX characters
together at most: beyond that each keeps fewer hashes, all alike.
"""

from __future__ import annotations

import base64
import binascii
import math
from collections.abc import Sequence
from typing import NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from s2r_runtime.errors import ConfigError
from s2r_runtime.modelspec import COMPACT, PREFIX, is_sketch

Array = NDArray[np.float64]
Hashes = NDArray[np.uint64]

CELL = 1e-5
"""Of a column's spread: a hundred times what rounding to 7 digits changes, and small beside any motion."""
COARSER = 10
KEPT = 16_384
"""150 KB of text; of 600 transitions out of two million rows, 99.9 % are found."""
TEXT_MAX = 3 << 20
"""Of all sketches of a model: twenty fits with KEPT hashes each. A model's file may have 4 MB (`toml_text`)."""
FALSE_BITS = 24
"""Two rows that are found are too many up to 10^5 rows that are looked up: beyond, hashes that agree by chance count (Poisson, ALPHA)."""
MIN_KEPT = 16
"""A model of hundreds of thousands of fits outgrows its file, and is refused for that."""
MIN_SEEN = 2
"""A transition has two rows; one may be where odometry always begins."""
ALPHA, SAFETY = 1e-3, 3.0
"""Of fresh recordings of the same motion, this share is refused at most; and how much denser one may be than the fit's."""
FEW = 7
"""Added to how often a coarse sensor's cell came again: where the mean is that many, none at all has probability ALPHA (Poisson)."""
BITS = 40
_MASK = np.uint64((1 << BITS) - 1)


class _Sketch(msgspec.Struct, frozen=True):
    """cells: (c,) of each column; angles: which states; chance: of one row; grids: KEPT lowest hashes of each; whole: those are all."""

    angles: tuple[int, ...]
    cells: tuple[float, ...]
    chance: float
    whole: bool
    grids: tuple[bytes, bytes]


class _List(msgspec.Struct, frozen=True):
    """n hashes of BITS bits without the lowest `shift`, sorted. code: `low` bits of each, then a bitmap of the others."""

    n: int
    shift: int
    low: int
    code: bytes


class _Compact(msgspec.Struct, frozen=True):
    """As `_Sketch`."""

    angles: tuple[int, ...]
    cells: tuple[float, ...]
    chance: float
    whole: bool
    grids: tuple[_List, _List]


class _Read(NamedTuple):
    """A sketch, of either form. grids: hashes without the lowest `shifts` bits, (n,) each, sorted."""

    angles: tuple[int, ...]
    cells: tuple[float, ...]
    chance: float
    whole: bool
    grids: tuple[Hashes, Hashes]
    shifts: tuple[int, int]


class Seen(NamedTuple):
    """rows: how many different rows the fit saw, of `of` that could be looked up; refused: more than chance makes."""

    rows: int
    of: int
    refused: bool


def united(*fitted_on: Sequence[str]) -> tuple[str, ...]:
    """What several fits of a model saw, each once; their sketches in TEXT_MAX characters. Raises ConfigError if one of them is damaged."""
    every = tuple(dict.fromkeys(text for one in fitted_on for text in one))
    kept, texts = KEPT, every
    while sum(len(text) for text in texts if is_sketch(text)) > TEXT_MAX and kept > MIN_KEPT:
        texts = tuple(_thinned(text, kept) if is_sketch(text) else text for text in every)
        kept -= kept // 8
    return texts


def sketch(runs: Sequence[Array], angles: Sequence[int], form: str = COMPACT) -> tuple[str, ...]:
    """The sketch of these runs, each (m, nx), as text; none if no row has all states. form: COMPACT or PREFIX."""
    parts = [_plain(run, angles) for run in runs]
    rows = np.concatenate(parts) if parts else np.empty((0, 0))
    if not len(rows):
        return ()
    low, high = np.min(rows, axis=0), np.max(rows, axis=0)
    cells = np.maximum(CELL * (high - low), 1e-9 * np.maximum(1.0, np.maximum(np.abs(low), np.abs(high))))
    grids = [np.unique(_hashes(rows, cells, shift)) for shift in (0.0, 0.5)]
    raw = np.concatenate(runs)
    chance = _chance(parts, cells, coarse=_is_coarse(raw[np.all(np.isfinite(raw), axis=1)], CELL))
    whole = all(len(grid) <= KEPT for grid in grids)
    first, second = (grid[:KEPT] for grid in grids)
    if form == PREFIX:
        old = _Sketch(tuple(angles), tuple(cells.tolist()), chance, whole, (_packed(first), _packed(second)))
        return (PREFIX + base64.b64encode(msgspec.msgpack.encode(old)).decode(),)
    return (_text(_Read(tuple(angles), tuple(cells.tolist()), chance, whole, (first, second), (0, 0))),)


def seen(text: str, runs: Sequence[Array]) -> Seen:
    """What of these runs, each (m, nx), is in a sketch. Raises ConfigError if it is damaged."""
    from scipy.stats import binom

    made = _read(text)
    if any(not 0 <= a < run.shape[1] for run in runs for a in made.angles):
        raise _damaged("its angles are of another model")
    cells, parts = np.array(made.cells), [_plain(run, made.angles) for run in runs]
    rows = np.concatenate(parts) if parts else np.empty((0, 0))
    if not len(rows) or rows.shape[1] != len(cells) or not all(len(grid) for grid in made.grids):
        return Seen(0, 0, refused=False)
    own = [_hashes(rows, cells, shift) for shift in (0.0, 0.5)]
    looked = np.zeros(len(rows), dtype=np.bool_)
    found = np.zeros(len(rows), dtype=np.bool_)
    by_hash = 0.0
    for grid, shift, hashes in zip(made.grids, made.shifts, own, strict=True):
        shortened = hashes >> np.uint64(shift)
        looked |= np.ones(len(rows), dtype=np.bool_) if made.whole else shortened <= grid[-1]
        found |= np.isin(shortened, grid)
        by_hash += len(grid) / (int(_MASK >> np.uint64(shift) if made.whole else grid[-1]) + 1)
    number, of = len(np.unique(own[0][found])), len(np.unique(own[0][looked]))
    bar = max(MIN_SEEN - 1, int(binom.ppf(1.0 - ALPHA, of, min(1.0, SAFETY * made.chance + by_hash))) if of else 0)
    return Seen(number, of, number > bar)


def _plain(run: Array, angles: Sequence[int]) -> Array:
    """(m, c) rows with all states, angles on circles."""
    run = run[np.all(np.isfinite(run), axis=1)]
    angles = list(angles)
    return np.column_stack([np.delete(run, angles, axis=1), np.cos(run[:, angles]), np.sin(run[:, angles])])


def _hashes(rows: Array, cells: Array, shift: float) -> Hashes:
    """(n,) BITS bits of each row's cell (splitmix64's finaliser over the columns)."""
    out = np.full(len(rows), np.uint64(0x9E3779B97F4A7C15))
    for column, cell in zip(rows.T, cells, strict=True):
        out ^= np.clip(np.floor(column / cell + shift), -4e18, 4e18).astype(np.int64).view(np.uint64)
        out ^= out >> np.uint64(30)
        out *= np.uint64(0xBF58476D1CE4E5B9)
        out ^= out >> np.uint64(27)
        out *= np.uint64(0x94D049BB133111EB)
        out ^= out >> np.uint64(31)
    return out & _MASK


def _is_coarse(rows: Array, cell: float) -> bool:
    """Whether all columns (n, nx) are multiples of a step that is larger than `cell` of their spread."""
    for column in rows.T:
        apart = np.diff(np.unique(column))
        apart = apart[apart > 1e-9 * np.ptp(column)]
        if not len(apart):
            continue
        many = apart / np.min(apart)
        if np.min(apart) < cell * np.ptp(column) or np.any(np.abs(many - np.round(many)) > 0.01 * np.maximum(1.0, 1e-3 * many)):
            return False
    return True


def _chance(parts: Sequence[Array], cells: Array, *, coarse: bool) -> float:
    """That a fresh row falls into a cell of these rows. coarse: of a coarse sensor."""
    wide = cells if coarse else COARSER * cells
    places, exact = [], []
    for part in parts:
        place = _hashes(part, wide, 0.0)
        enters = np.append(True, place[1:] != place[:-1])[: len(place)]
        places.append(place[enters])
        exact.append(_hashes(part[enters], cells, 0.0))
    place, fine = np.concatenate(places), np.concatenate(exact)
    if not coarse:  # a row that is there twice is a copy, and says nothing of chance
        place = place[np.unique(np.column_stack([place, fine]), axis=0, return_index=True)[1]]
    _, inverse, counts = np.unique(place, return_inverse=True, return_counts=True)
    again = int(np.count_nonzero(counts[inverse] > 1))
    return min(1.0, (again + FEW) / len(place)) if coarse else again / len(place) / COARSER


# ---------------------------------------------------------------- as text


def _damaged(why: object) -> ConfigError:
    return ConfigError(f"model: fitted_on: a sketch of rows is damaged: {why}")


def _read(text: str) -> _Read:
    """Raises ConfigError if it is damaged."""
    compact = text.startswith(COMPACT)
    try:
        data = base64.b64decode(text.removeprefix(COMPACT if compact else PREFIX), validate=True)
        if compact:
            new = msgspec.msgpack.decode(data, type=_Compact)
            made = _Read(new.angles, new.cells, new.chance, new.whole, (_numbers(new.grids[0]), _numbers(new.grids[1])), _shifts(new.grids))
        else:
            old = msgspec.msgpack.decode(data, type=_Sketch)
            made = _Read(old.angles, old.cells, old.chance, old.whole, (_unpacked(old.grids[0]), _unpacked(old.grids[1])), (0, 0))
        if not (0.0 <= made.chance <= 1.0 and all(0.0 < cell < math.inf for cell in made.cells)):
            raise ValueError("its numbers are out of range")
    except (binascii.Error, ValueError, msgspec.MsgspecError) as error:
        raise _damaged(error) from None
    return made


def _shifts(grids: tuple[_List, _List]) -> tuple[int, int]:
    return grids[0].shift, grids[1].shift


def _text(made: _Read) -> str:
    """The compact form."""
    first, second = (_code(grid, shift) for grid, shift in zip(made.grids, made.shifts, strict=True))
    compact = _Compact(made.angles, made.cells, made.chance, made.whole, (first, second))
    return COMPACT + base64.b64encode(msgspec.msgpack.encode(compact)).decode()


def _thinned(text: str, kept: int) -> str:
    """The compact form with at most `kept` hashes of each grid."""
    made = _read(text)
    whole = made.whole and all(len(grid) <= kept for grid in made.grids)
    return _text(made._replace(whole=whole, grids=(made.grids[0][:kept], made.grids[1][:kept])))


def _code(hashes: Hashes, shift: int) -> _List:
    """hashes: (n,) sorted, without the lowest `shift` bits; they lose further bits as FALSE_BITS allows."""
    n = len(hashes)
    spare = int(hashes[-1]) // n if n else 0  # of it, 2^FALSE_BITS and up to twice as much stays
    more = max(0, spare.bit_length() - 1 - FALSE_BITS)
    short = hashes >> np.uint64(more)
    low = max(0, (int(short[-1]) // n).bit_length() - 1) if n else 0
    high = (short >> np.uint64(low)).astype(np.int64) + np.arange(n)
    bitmap = np.zeros(int(high[-1]) + 1 if n else 0, dtype=np.uint8)
    bitmap[high] = 1
    digits = (short[:, None] >> np.arange(low, dtype=np.uint64)) & np.uint64(1)
    return _List(n, shift + more, low, np.packbits(np.concatenate([digits.astype(np.uint8).ravel(), bitmap])).tobytes())


def _numbers(code: _List) -> Hashes:
    """(n,) sorted. Raises ValueError."""
    if not (0 <= code.n <= KEPT and 0 <= code.low <= BITS and 0 <= code.shift <= BITS):
        raise ValueError("its numbers are out of range")
    bits = np.unpackbits(np.frombuffer(code.code, dtype=np.uint8))
    ones = np.flatnonzero(bits[code.n * code.low :])
    if len(ones) != code.n:
        raise ValueError("its lists do not have the length that they state")
    digits = bits[: code.n * code.low].reshape(code.n, code.low).astype(np.uint64)
    high = (ones - np.arange(code.n)).astype(np.uint64) << np.uint64(code.low)
    return high | np.sum(digits << np.arange(code.low, dtype=np.uint64), axis=1, dtype=np.uint64)


def _packed(hashes: Hashes) -> bytes:
    return hashes.astype("<u8").view(np.uint8).reshape(-1, 8)[:, : BITS // 8].tobytes()


def _unpacked(packed: bytes) -> Hashes:
    """Sorted, as they were packed. Raises ValueError."""
    short = np.frombuffer(packed, dtype=np.uint8).reshape(-1, BITS // 8)
    whole = np.zeros((len(short), 8), dtype=np.uint8)
    whole[:, : BITS // 8] = short
    return whole.view("<u8").ravel().astype(np.uint64)
