"""Eight-lane values in kernels: each operation against NumPy, and what lies beyond the end of a span."""

import numpy as np
from numba import njit

from nl_env.lanes import (
    EXACT,
    LANES,
    first_of,
    flags,
    from_bits,
    fused,
    gather,
    how_many,
    leading,
    load,
    load_some,
    quotient,
    ramp,
    row_of,
    shifted_down,
    splat,
    store,
    store_some,
    to_bits,
    to_float,
    to_int,
    where,
)

OPTIONS = {**EXACT, "cache": False}


@njit(**OPTIONS)
def divide(values, out):
    row = row_of(values, 0)
    one = splat(np.float32(1))
    store(row_of(out, 0), 0, one / load(row, 0))
    store(row_of(out, 1), 0, fused(load(row, 0), load(row, 0), one))


@njit(**OPTIONS)
def divide_quickly(values, out):
    store(row_of(out, 0), 0, quotient(splat(np.float32(1)), load(row_of(values, 0), 0)))


@njit(**OPTIONS)
def look_up(table, places, count, out):
    found = gather(row_of(table, 0), load(row_of(places, 0), 0), ramp() < splat(count))
    store(row_of(out, 0), 0, found)


@njit(**OPTIONS)
def whole_numbers(values, out):
    below = to_int(load(row_of(values, 0), 0))
    fraction = load(row_of(values, 0), 0) - to_float(below)
    store(row_of(out, 0), 0, (below & splat(255)) << splat(2) | (below >> splat(28)))
    store(row_of(out, 1), 0, where(fraction > splat(np.float32(0.5)), splat(1), splat(0)))


@njit(**OPTIONS)
def count_leading(values, label):
    return leading(load(row_of(values, 0), 0) == splat(label))


@njit(**OPTIONS)
def add_to_some(values, count, otherwise, out):
    some = first_of(count)
    read = load_some(row_of(values, 0), 0, some, splat(otherwise))
    store(row_of(out, 0), 0, read)
    store_some(row_of(out, 1), 0, some, read + splat(np.float32(1)))


@njit(**OPTIONS)
def look_up_floats(table, places, count, out):
    store(row_of(out, 0), 0, gather(row_of(table, 0), load(row_of(places, 0), 0), first_of(count)))


@njit(**OPTIONS)
def between(values, low, high):
    row = load(row_of(values, 0), 0)
    inside = (row >= splat(low)) & (row <= splat(high))
    outside = (row < splat(low)) | (row > splat(high))
    return flags(inside), flags(outside), how_many(inside)


@njit(**OPTIONS)
def take_apart(values, out):
    bits = to_bits(load(row_of(values, 0), 0))
    store(row_of(out, 0), 0, from_bits(bits + splat(1)))
    store(row_of(out, 1), 0, to_float(shifted_down(bits - splat(0x3F800000), splat(23))))


def random_row(rng, low, high):
    return rng.uniform(low, high, (1, LANES)).astype(np.float32)


def test_division_and_fused_product_are_exact():
    values, out = random_row(np.random.default_rng(1), 0.001, 900.0), np.zeros((2, LANES), np.float32)
    divide(values, out)
    assert np.array_equal(out[0], np.float32(1) / values[0])
    exact = (values[0].astype(np.float64) ** 2 + 1).astype(np.float32)
    assert np.allclose(out[1], exact, rtol=2e-7, atol=0)


def test_the_quick_quotient_is_close():
    values, out = random_row(np.random.default_rng(2), 0.001, 900.0), np.zeros((1, LANES), np.float32)
    divide_quickly(values, out)
    assert np.allclose(out * values, 1, rtol=5e-7, atol=0)


def test_only_wanted_elements_are_looked_up():
    places = np.array([[3, 1, 4, 1, 5, 2**30, -7, 2**30]], np.int32)
    table = np.arange(10, 20, dtype=np.uint32)[None]
    out = np.full((1, LANES), -1, np.int32)
    look_up(table, places, 5, out)
    assert out.tolist() == [[13, 11, 14, 11, 15, 0, 0, 0]]


def test_bytes_are_looked_up_on_their_own():
    places, table = np.arange(LANES, dtype=np.int32)[None], np.arange(250, 250 - 16, -1).astype(np.uint8)
    out = np.zeros((1, LANES), np.int32)
    look_up(table, places, LANES, out)
    assert out.tolist() == [list(range(250, 242, -1))]


def test_integers_and_comparisons():
    values, out = (
        np.array([[0.2, 0.7, 3.6, 300.4, -1.0, -0.9, 255.9, 7.5]], np.float32),
        np.zeros((2, 8), np.int32),
    )
    whole_numbers(values, out)
    whole = values[0].astype(np.int32)
    assert out[0].tolist() == [((int(n) & 255) << 2) | ((int(n) & 0xFFFFFFFF) >> 28) for n in whole]
    assert out[1].tolist() == (values[0] - whole > 0.5).astype(int).tolist()


def test_leading_lanes_are_counted():
    for count in range(LANES + 1):
        values = np.full((1, LANES), 5, np.int32)
        values[0, count:] = 4
        assert count_leading(values, np.int32(5)) == count


def test_a_caller_with_fast_math_does_not_loosen_a_division():
    @njit(fastmath=True, error_model="numpy")
    def fast(values, out):
        divide(values, out)

    values, out = random_row(np.random.default_rng(3), 0.001, 900.0), np.zeros((2, LANES), np.float32)
    fast(values, out)
    assert np.array_equal(out[0], np.float32(1) / values[0])


def test_only_wanted_elements_are_read_and_written():
    memory = np.arange(2 * LANES, dtype=np.float32)
    for count in range(LANES + 1):
        out = np.full((2, LANES), -1, np.float32)
        add_to_some(memory[None], count, np.float32(7), out)
        assert out[0].tolist() == [*range(count), *[7] * (LANES - count)]
        assert out[1].tolist() == [*range(1, count + 1), *[-1] * (LANES - count)]


def test_floats_are_looked_up():
    places = np.array([[3, 1, 4, 1, 5, 2**30, -7, 2**30]], np.int32)
    table, out = np.arange(10, 20, dtype=np.float32)[None] / 4, np.full((1, LANES), -1, np.float32)
    look_up_floats(table, places, 5, out)
    assert out.tolist() == [[3.25, 2.75, 3.5, 2.75, 3.75, 0, 0, 0]]


def test_limits_belong_to_the_inside_and_nan_to_neither_side():
    values = np.array([[1, 2, 3, 4, 5, np.nan, 2.5, 9]], np.float32)
    inside, outside, count = between(values, np.float32(2), np.float32(4))
    assert inside == 0b01001110 and outside == 0b10010001 and count == 4


def test_bits_of_floats_and_a_shift_that_keeps_the_sign():
    values, out = np.array([[1, 0.3, 2, 5, 0.01, 300, 1e-30, 0.5]], np.float32), np.zeros((2, 8), np.float32)
    take_apart(values, out)
    assert out[0].tolist() == np.nextafter(values[0], np.float32(np.inf)).tolist()
    assert out[1].tolist() == np.floor(np.log2(values[0].astype(np.float64))).tolist()
