"""The sums behind the metrics, eight pixels at a time and in one order on every machine.

A term is computed in float32 and summed in float64, in eight lanes: lane j adds up pixels j, j + 8, j + 16
and so on, then the halves are added to each other until one number is left, and pixels beyond the last
eight follow one by one. Where prediction and truth are the same depth every error is exactly zero; sky
predicted as sky, or a scene at rest, therefore costs a few comparisons.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit

from nl_env.depth.lane_sums import add, equal, magnitude, sound, total, without, zeros
from nl_env.lanes import (
    EXACT,
    LANES,
    first_of,
    from_bits,
    fused,
    how_many,
    load,
    load_some,
    row_of,
    shifted_down,
    splat,
    to_bits,
    to_float,
    where,
)

_KERNEL: dict[str, Any] = {"cache": True, "error_model": "numpy", "boundscheck": False}

_LN2 = np.float32(math.log(2.0))
_SQRT_HALF_BITS = np.int32(0x3F3504F3)
_MANTISSA = np.int32(0x007FFFFF)
_ATANH = tuple(np.float32(2.0 / k) for k in (1, 3, 5, 7, 9))
_ZERO, _ONE = np.float32(0), np.float32(1)
_DELTA_1, _DELTA_2, _DELTA_3 = np.float32(1.25), np.float32(1.25**2), np.float32(1.25**3)
_TEN_PERCENT = np.float32(1.1)
_FLOOR = np.float32(1e-8)


@njit(**EXACT)
def _larger(a, b):  # type: ignore[no-untyped-def]
    return where(a > b, a, b)


@njit(**EXACT)
def _smaller(a, b):  # type: ignore[no-untyped-def]
    return where(a < b, a, b)


@njit(**EXACT)
def _log(x):  # type: ignore[no-untyped-def]
    """Natural logarithms of positive normal float32.

    ``x = 2^k m`` with m in [sqrt(1/2), sqrt(2)), and ``ln m = 2 atanh(s)``, ``s = (m - 1) / (m + 1)``.
    """
    shifted = to_bits(x) - splat(_SQRT_HALF_BITS)
    k = to_float(shifted_down(shifted, splat(np.int32(23))))
    m = from_bits((shifted & splat(_MANTISSA)) + splat(_SQRT_HALF_BITS))
    s = (m - splat(_ONE)) / (m + splat(_ONE))
    q = s * s
    series = fused(q, splat(_ATANH[4]), splat(_ATANH[3]))
    for power in (2, 1, 0):
        series = fused(q, series, splat(_ATANH[power]))
    return fused(s, series, k * splat(_LN2))


@njit(**EXACT)
def _add_paper(sums, p_raw, g_raw, max_depth):  # type: ignore[no-untyped-def]
    """The paper's terms of eight pixels on top of ``sums``."""
    valid, squared, squared_log, relative, squared_relative, inside_1, inside_2, inside_3 = sums
    use = (g_raw > splat(_ZERO)) & (g_raw < max_depth)
    # Pixels without a valid truth add exact zeros: both depths are read as 1 m.
    g = where(use, g_raw, splat(_ONE))
    p = where(use, p_raw, splat(_ONE))
    p = where(p < splat(_FLOOR), splat(_FLOOR), p)
    used = how_many(use)
    if how_many(equal(p, g)) == LANES:
        inside_1, inside_2, inside_3 = inside_1 + used, inside_2 + used, inside_3 + used
    else:
        ratio = p / g
        factor = _larger(ratio, g / p)
        difference = p - g
        square = difference * difference
        log = _log(ratio)
        squared = add(squared, square)
        squared_log = add(squared_log, log * log)
        relative = add(relative, magnitude(difference) / g)
        squared_relative = add(squared_relative, square / g)
        inside_1 += how_many(use & (factor < splat(_DELTA_1)))
        inside_2 += how_many(use & (factor < splat(_DELTA_2)))
        inside_3 += how_many(use & (factor < splat(_DELTA_3)))
    return valid + used, squared, squared_log, relative, squared_relative, inside_1, inside_2, inside_3


@njit(**EXACT)
def _add_full(sums, p_raw, g_raw, max_depth, min_depth):  # type: ignore[no-untyped-def]
    """The full-image terms of eight pixels on top of ``sums``."""
    broken, log, inverse, squared_inverse, bad_25, bad_10, false_return, missed_return = sums
    broken += LANES - how_many(sound(p_raw) & sound(g_raw))
    g_return = (g_raw > splat(_ZERO)) & (g_raw < max_depth)
    p_return = (p_raw > splat(_ZERO)) & (p_raw < max_depth)
    g = where(g_return, _larger(g_raw, min_depth), max_depth)
    p = where(p_return, _larger(p_raw, min_depth), max_depth)
    if how_many(equal(p, g)) != LANES:
        difference = splat(_ONE) / p - splat(_ONE) / g
        factor = _larger(p, g) / _smaller(p, g)
        log = add(log, _log(factor))
        inverse = add(inverse, magnitude(difference))
        squared_inverse = add(squared_inverse, difference * difference)
        bad_25 += how_many(factor > splat(_DELTA_1))
        bad_10 += how_many(factor > splat(_TEN_PERCENT))
        false_return += how_many(without(p_return, g_return))
        missed_return += how_many(without(g_return, p_return))
    return broken, log, inverse, squared_inverse, bad_25, bad_10, false_return, missed_return


@njit(**EXACT)
def _last(row, column, number):  # type: ignore[no-untyped-def]
    """The last ``number`` pixels of a row, fewer than eight; 0 in the other lanes."""
    return load_some(row, column, first_of(number), splat(_ZERO))


@njit(**EXACT)
def _no_paper():  # type: ignore[no-untyped-def]
    return 0, zeros(), zeros(), zeros(), zeros(), 0, 0, 0


@njit(**EXACT)
def _no_full():  # type: ignore[no-untyped-def]
    return 0, zeros(), zeros(), zeros(), 0, 0, 0, 0


@njit(**EXACT)
def _paper_total(sums, last):  # type: ignore[no-untyped-def]
    """What :func:`paper_sums` returns, of the whole eights and of the ``last`` pixels."""
    return (
        sums[0] + last[0],
        total(sums[1], last[1]),
        total(sums[2], last[2]),
        total(sums[3], last[3]),
        total(sums[4], last[4]),
        sums[5] + last[5],
        sums[6] + last[6],
        sums[7] + last[7],
    )


@njit(**EXACT)
def _full_total(sums, last):  # type: ignore[no-untyped-def]
    """What :func:`full_sums` returns, of the whole eights and of the ``last`` pixels."""
    return (
        sums[0] + last[0],
        total(sums[1], last[1]),
        total(sums[2], last[2]),
        total(sums[3], last[3]),
        sums[4] + last[4],
        sums[5] + last[5],
        sums[6] + last[6],
        sums[7] + last[7],
    )


@njit(**_KERNEL)
def paper_sums(pred, truth, max_depth):  # type: ignore[no-untyped-def]
    """Sums over the valid pixels of two flat images, ``0 < truth < max_depth``.

    Returns:
        Number of valid pixels; squared difference, squared difference of logarithms, relative difference,
        squared difference over truth; number of pixels within each of three factors.
    """
    p, g = row_of(pred, 0), row_of(truth, 0)
    limit = splat(max_depth)
    whole = truth.size - truth.size % LANES
    sums = _no_paper()
    for i in range(0, whole, LANES):
        sums = _add_paper(sums, load(p, i), load(g, i), limit)
    rest = truth.size - whole
    last = _add_paper(_no_paper(), _last(p, whole, rest), _last(g, whole, rest), limit)
    return _paper_total(sums, last)


@njit(**_KERNEL)
def full_sums(pred, truth, max_depth, min_depth):  # type: ignore[no-untyped-def]
    """Sums over all pixels of two flat images.

    Returns:
        Number of pixels with a depth that is negative or not finite; difference of logarithms, of inverse
        depth, its square; number of pixels beyond each of two factors, of false and of missed returns.
    """
    p, g = row_of(pred, 0), row_of(truth, 0)
    limit, least = splat(max_depth), splat(min_depth)
    whole = truth.size - truth.size % LANES
    sums = _no_full()
    for i in range(0, whole, LANES):
        sums = _add_full(sums, load(p, i), load(g, i), limit, least)
    rest = truth.size - whole
    last = _add_full(_no_full(), _last(p, whole, rest), _last(g, whole, rest), limit, least)
    return _full_total(sums, last)


@njit(**_KERNEL)
def both_sums(pred, truth, max_depth, min_depth):  # type: ignore[no-untyped-def]
    """:func:`paper_sums` and :func:`full_sums` in one pass."""
    p, g = row_of(pred, 0), row_of(truth, 0)
    limit, least = splat(max_depth), splat(min_depth)
    whole = truth.size - truth.size % LANES
    paper, full = _no_paper(), _no_full()
    for i in range(0, whole, LANES):
        p_raw, g_raw = load(p, i), load(g, i)
        paper = _add_paper(paper, p_raw, g_raw, limit)
        full = _add_full(full, p_raw, g_raw, limit, least)
    rest = truth.size - whole
    p_raw, g_raw = _last(p, whole, rest), _last(g, whole, rest)
    last_paper = _add_paper(_no_paper(), p_raw, g_raw, limit)
    last_full = _add_full(_no_full(), p_raw, g_raw, limit, least)
    return _paper_total(paper, last_paper), _full_total(full, last_full)
