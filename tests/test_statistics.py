import numpy as np
import pytest

from nl_env.statistics import (
    ACTIVITY_FIELDS,
    GRID,
    SLICE_STATISTICS,
    WINDOWS,
    ActivityMemory,
    compress,
    slice_statistics,
)

REGIONS = GRID[0] * GRID[1]


def random_images(count, size=(48, 64), seed=0):
    rng = np.random.default_rng(seed)
    images = np.full((count, *size), 128, np.uint8)
    active = rng.random(images.shape) < 0.2
    images[active] = rng.integers(0, 256, np.count_nonzero(active))
    return images


def test_a_region_is_described_by_its_share_of_active_pixels_and_its_mean_magnitude():
    image = np.full((120, 160), 128, np.uint8)
    image[40:80, 80:90] = 131  # a quarter of row 1, column 2
    image[0, 0], image[0, 1] = 0, 255  # the largest magnitudes of both signs
    active, magnitude = slice_statistics(image).reshape(2, *GRID)
    assert active[1, 2] == 0.25 and magnitude[1, 2] == 0.75
    assert active[0, 0] == np.float32(2 / 1600) and magnitude[0, 0] == np.float32((128 + 127) / 1600)
    active[1, 2] = active[0, 0] = magnitude[1, 2] = magnitude[0, 0] = 0
    assert not active.any() and not magnitude.any()


def test_statistics_do_not_depend_on_the_resolution():
    (small,) = random_images(1)
    large = small.repeat(5, axis=0).repeat(5, axis=1)
    np.testing.assert_array_equal(slice_statistics(large), slice_statistics(small))


def test_every_pixel_counts_once_where_the_grid_does_not_divide_the_image():
    for size in ((50, 67), (3, 4), (260, 346)):
        image = np.full(size, 129, np.uint8)
        assert (slice_statistics(image) == 1).all()


def test_an_image_gives_the_same_numbers_alone_and_among_others():
    images = random_images(130)
    together = slice_statistics(images)
    assert together.shape == (130, SLICE_STATISTICS) and together.dtype == np.float32
    for k in (0, 64, 129):
        np.testing.assert_array_equal(slice_statistics(images[k]), together[k])
    np.testing.assert_array_equal(slice_statistics(images[::2]), together[::2])


@pytest.mark.parametrize(
    "images",
    [
        np.zeros((48, 64), np.int16),
        np.zeros(48, np.uint8),
        np.zeros((1, 1, 48, 64), np.uint8),
        np.zeros((2, 64), np.uint8),
    ],
)
def test_other_images_are_refused(images):
    with pytest.raises(ValueError, match="images: found"):
        slice_statistics(images)


def test_compression_keeps_the_order_and_the_bounds():
    squeezed = compress(np.array([0.0, 0.1, 0.2, 1.0, 5 * 128.0], np.float32))
    assert squeezed[0] == 0 and squeezed[2] == 0.5 and squeezed[-1] < 1
    assert (np.diff(squeezed) > 0).all()


def by_hand(rows, lidar, triggered):
    """Window sums at every slice, from the definition."""
    sums, made, last = [], 0, [0]
    for k, row in enumerate(rows, 1):
        if lidar[k - 1]:
            made = k
            last.append(k)
        zero = np.zeros_like(row)
        before = rows[last[-2] : last[-1]].sum(axis=0) if len(last) > 1 else zero
        sums.append([row, rows[made:k].sum(axis=0), rows[last[-1] : k].sum(axis=0), before])
        if triggered[k - 1]:
            made = k
    return np.array(sums, np.float32)


def test_windows_are_the_sums_their_names_say():
    rows = np.random.default_rng(1).integers(0, 9, (17, SLICE_STATISTICS)).astype(np.float32)
    lidar = np.arange(1, 18) % 5 == 0
    triggered = np.isin(np.arange(1, 18), [2, 3, 8, 14]) & ~lidar
    memory = ActivityMemory()
    for k, expected in enumerate(by_hand(rows, lidar, triggered)):
        memory.see(rows[k], lidar[k])
        np.testing.assert_array_equal(memory.windows, expected)
        observed = memory.observed()
        np.testing.assert_array_equal(observed, compress(expected).ravel())
        assert observed.shape == (ACTIVITY_FIELDS,) and not np.shares_memory(observed, memory.windows)
        memory.act(triggered[k])
    assert WINDOWS == ("slice", "since_depth", "since_lidar", "last_interval")


def test_a_batch_equals_its_members_and_resets_one_by_one():
    rng = np.random.default_rng(2)
    batch, singles = ActivityMemory((3,)), [ActivityMemory() for _ in range(3)]
    for k in range(12):
        rows = rng.random((3, SLICE_STATISTICS), np.float32)
        lidar, triggered = rng.random(3) < 0.2, rng.random(3) < 0.4
        if k == 7:
            batch.reset(np.array([False, True, False]))
            singles[1].reset()
        batch.see(rows, lidar)
        for place, memory in enumerate(singles):
            memory.see(rows[place], lidar[place])
            np.testing.assert_array_equal(batch.observed()[place], memory.observed())
            memory.act(triggered[place])
        batch.act(triggered)
    assert batch.windows.any()
    batch.reset()
    assert not batch.windows.any()
