"""Small pictures of event frames, and what is remembered of those before."""

import numpy as np
import pytest

from agents.pictures import MOST, MOST_EVENTS, PictureMemory, memory_size, picture, picture_shape

HEIGHT, WIDTH = 32, 40


def frames(count, scale=3.0, seed=0):
    """``(count, H, W)`` image observations of drawn event sums, the last column saturated."""
    sums = np.random.default_rng(seed).normal(0, scale, (count, HEIGHT, WIDTH)).round().clip(-128, 127)
    sums[..., -4:] = 127
    return (sums + 128).astype(np.uint8)


def test_blocks_hold_clipped_sums_and_magnitudes():
    images = frames(3)
    sums = np.clip(images.astype(int) - 128, -MOST_EVENTS, MOST_EVENTS)
    shown = picture(images)
    assert shown.shape == (3, 2, 8, 10) and shown.dtype == np.int8
    for channel, values in enumerate((sums, abs(sums))):
        blocks = values.reshape(3, 8, 4, 10, 4).sum(axis=(2, 4))
        np.testing.assert_array_equal(shown[:, channel], blocks)
    assert shown[0, 1, 0, -1] == 16 * MOST_EVENTS <= MOST


@pytest.mark.parametrize("shape", [(28, 40), (34, 40), (32, 42)])
def test_sizes_that_do_not_fit_are_refused(shape):
    with pytest.raises(ValueError, match=f"found event frames of {shape[0]}x{shape[1]}, expected multiples"):
        picture_shape(*shape)


def test_the_memory_sums_since_the_held_frame_and_saturates():
    shape = picture_shape(HEIGHT, WIDTH)
    memory = np.zeros((2, memory_size(shape)), np.float32)
    remembered = PictureMemory(memory, shape)
    shown = picture(frames(12))
    # Shares of a LiDAR period: the second environment triggers at its third slice.
    ages = [(0.2, 0.2), (0.4, 0.4), (0.6, 0.6), (0.8, 0.2), (0.0, 0.0), (0.2, 0.2)]
    since = [([0], [0]), ([0, 1], [0, 1]), ([0, 1, 2], [0, 1, 2]), ([0, 1, 2, 3], [3]), ([], []), ([5], [5])]
    for k, (age, slices) in enumerate(zip(ages, since, strict=True)):
        found = remembered.see(shown[[k, k]], np.array(age, np.float32))
        np.testing.assert_array_equal(found[:, :2], shown[[k, k]])
        for i in range(2):
            total = sum((shown[j, 1].astype(int) for j in slices[i]), np.zeros(shape, int))
            np.testing.assert_array_equal(found[i, 2], np.minimum(total, MOST))
    assert memory.any()
