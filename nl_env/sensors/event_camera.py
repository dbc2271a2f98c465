"""Event camera: log-intensity change detection with the noise of a real sensor.

The model, in the order a tick applies it (ESIM for the crossings, v2e for the noise sources):

* **Bandwidth.** The photoreceptor is a first-order low-pass on log intensity whose corner frequency is
  ``cutoff_hz * (I + g) / (1 + g)``, ``g = 20/255``: dark pixels are slow. A new intensity is held over the
  tick that ends with it, and the response to that step is exact for any tick length.
* **Leak.** The level drifts upwards by ``leak_rate_hz * threshold_on`` per second.
* **Crossings.** Between two ticks the level moves linearly in time; each threshold that it reaches gives an
  event at the interpolated microsecond. The reference moves by one threshold per crossing, also when the
  event itself falls into the refractory period and is lost. A pixel sends at most one event per us.
* **Mismatch.** Every pixel has its own ON and OFF threshold, normal around the nominal one, at least 0.01.
* **Shot noise.** Random events, up to four times more in the dark; each resets its pixel.

Times are ``int64`` us. Windows are half-open: a step covers ``[previous t, t)``, and a threshold reached
exactly at the end is stamped with the window's last microsecond. Crossing times are computed in single
precision relative to the tick: the error is below 1 us where the level moves 0.01 or more in a 5 ms tick.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from nl_env.config import EventCameraConfig
from nl_env.sensors.event_crossings import log_levels
from nl_env.sensors.event_kernels import all_positive, bin_tick, list_tick, sort_events
from nl_env.sensors.event_state import MAX_TICK_US, Pixels, Scratch, Tick
from nl_env.types import BINS, EVENT_DTYPE, SLICE_US

MIN_THRESHOLD = 0.01
"""Smallest contrast threshold that mismatch can give a pixel."""

MAX_SHOT_PROBABILITY = 0.9
"""Cap on the noise probability of one pixel in one tick."""

REBASE_US = 1 << 29
"""Age of the time base at which it moves forward, so that int32 pixel times never overflow."""

NEVER = -(1 << 30)
"""Time of the last event of a pixel that had none, us."""


class EventCamera:
    """Turns intensity images into events, tick by tick.

    Args:
        config: thresholds and noise.
        shape: ``(H, W)``.
        random_reference: start every pixel at a random place inside its window, so that a small first
            change does not fire all pixels at once; False starts all in the centre, at the first image.

    Attributes:
        config, shape: as given.
        noise_scale: factor on the shot-noise rate, >= 0 (weather). 1 unless set; kept by ``reset``.
    """

    def __init__(
        self, config: EventCameraConfig, shape: tuple[int, int], random_reference: bool = True
    ) -> None:
        if len(shape) != 2 or min(shape) < 1 or max(shape) > 32_768:
            raise ValueError(f"shape: found {shape!r}, expected (H, W) with sides from 1 to 32768")
        self.config = config
        self.shape = (int(shape[0]), int(shape[1]))
        self.random_reference = random_reference
        self.noise_scale = 1.0
        size = self.shape[0] * self.shape[1]
        self._pixels = Pixels.allocate(size)
        self._scratch = Scratch.allocate()
        self._keys = np.empty(size, np.uint64)
        self._noise_state = np.zeros(1, np.uint64)
        self._time: int | None = None
        self._base = 0

    def reset(self, intensity: NDArray[np.float32], t_us: int, rng: np.random.Generator) -> None:
        """Start at ``t_us`` with the first image; every random property is drawn anew from ``rng``.

        Args:
            intensity: ``(H, W)`` float32, linear, > 0; 1 is full brightness.
            t_us: time of the image, us.
            rng: source of mismatch, start references and the shot-noise seed.

        Raises:
            ValueError: intensity of another shape or dtype, or not finite and positive.
        """
        flat = self._checked(intensity)
        pixels, config = self._pixels, self.config
        for step, nominal in (
            (pixels.on_step, config.threshold_on),
            (pixels.off_step, config.threshold_off),
        ):
            rng.standard_normal(out=step, dtype=np.float32)
            step *= np.float32(config.threshold_mismatch)
            step += np.float32(nominal)
            np.maximum(step, np.float32(MIN_THRESHOLD), out=step)
        log_levels(flat, pixels.level)
        window = pixels.on_step + pixels.off_step
        if self.random_reference:
            # Strictly inside the window: a still scene stays silent.
            place = rng.random(flat.size, np.float32) * np.float32(0.998) + np.float32(0.001)
            np.add(pixels.level, place * window, out=pixels.on_at)
        else:
            np.add(pixels.level, pixels.on_step, out=pixels.on_at)
        np.subtract(pixels.on_at, window, out=pixels.off_at)
        pixels.last.fill(NEVER)
        pixels.apart.fill(0)
        self._noise_state[0] = rng.integers(0, 1 << 64, dtype=np.uint64)
        self._time = self._base = int(t_us)

    def accumulate(
        self, intensity: NDArray[np.float32], t_us: int, bins: NDArray[np.int16], slice_start_us: int
    ) -> int:
        """Advance to ``t_us`` and add the events to the bins of the slice that contains the step.

        Args:
            intensity: ``(H, W)`` float32 image at ``t_us``, linear, > 0.
            t_us: end of the step, us; later than the previous one.
            bins: ``(5, H, W)`` int16, C-contiguous, signed sums of five 4 ms bins; changed in place.
            slice_start_us: first microsecond of the slice.

        Returns:
            The number of events in ``[previous t, t_us)``.

        Raises:
            RuntimeError: before ``reset``.
            ValueError: bad intensity, time not advancing, a step outside the slice, or bad bins.
        """
        if bins.shape != (BINS, *self.shape) or bins.dtype != np.int16 or not bins.flags.c_contiguous:
            raise ValueError(
                f"bins: found {bins.dtype} {bins.shape}, expected C-contiguous int16 {(BINS, *self.shape)}"
            )
        flat, tick = self._begin(intensity, t_us, slice_start_us)
        if tick.offset < 0 or tick.offset + tick.length > SLICE_US:
            raise ValueError(
                f"slice_start_us: found {slice_start_us} for the step [{t_us - tick.length}, {t_us}), "
                f"expected a {SLICE_US} us slice that contains it"
            )
        count = bin_tick(
            flat,
            self._pixels,
            self._scratch,
            tick,
            self._noise_state,
            self._keys,
            bins.reshape(BINS, -1),
        )
        self._time = int(t_us)
        return count

    def events(self, intensity: NDArray[np.float32], t_us: int) -> NDArray[np.void]:
        """Advance to ``t_us`` and return the events of the step as an ``EVENT_DTYPE`` array, sorted by time.

        Same events and same state afterwards as :meth:`accumulate`; same arguments and errors.
        """
        flat, tick = self._begin(intensity, t_us, None)
        self._keys, count = list_tick(flat, self._pixels, self._scratch, tick, self._noise_state, self._keys)
        events = np.empty(count, EVENT_DTYPE)
        sort_events(self._keys[:count], tick.length, t_us - tick.length, self.shape[1], events)
        self._time = int(t_us)
        return events

    def _begin(
        self, intensity: NDArray[np.float32], t_us: int, slice_start_us: int | None
    ) -> tuple[NDArray[np.float32], Tick]:
        """Check a step and describe it to the kernels."""
        if self._time is None:
            raise RuntimeError("EventCamera: reset must be called first")
        length = int(t_us) - self._time
        if not 0 < length <= MAX_TICK_US:
            raise ValueError(
                f"t_us: found {t_us} after {self._time}, expected a step of 1 to {MAX_TICK_US} us forward"
            )
        if not 0 <= self.noise_scale < math.inf:
            raise ValueError(f"noise_scale: found {self.noise_scale!r}, expected a finite number >= 0")
        flat = self._checked(intensity)
        config = self.config
        leak_per_us = config.leak_rate_hz * config.threshold_on * 1e-6
        if self._time - self._base > REBASE_US or (self._time - self._base) * leak_per_us > 1.0:
            self._rebase(leak_per_us)
        start = self._time - self._base
        shots = config.shot_rate_hz * self.noise_scale * length * 1e-6
        return flat, Tick(
            start=start,
            length=length,
            offset=0 if slice_start_us is None else self._time - int(slice_start_us),
            leak_start=start * leak_per_us,
            leak_end=(start + length) * leak_per_us,
            bandwidth=2 * math.pi * config.cutoff_hz * length * 1e-6,
            refractory=int(config.refractory_us),
            shot_probability=min(shots, MAX_SHOT_PROBABILITY),
        )

    def _rebase(self, leak_per_us: float) -> None:
        """Move the time base to now, so that pixel times fit int32 and leaked levels stay small."""
        assert self._time is not None
        age = self._time - self._base
        for levels in (self._pixels.on_at, self._pixels.off_at):
            levels -= np.float32(age * leak_per_us)
        self._pixels.apart.fill(1)
        np.maximum(self._pixels.last - np.int64(age), NEVER, out=self._pixels.last, casting="same_kind")
        self._base = self._time

    def _checked(self, intensity: NDArray[np.float32]) -> NDArray[np.float32]:
        """``intensity`` as a flat contiguous array, or the reason why not."""
        if intensity.shape != self.shape or intensity.dtype != np.float32:
            raise ValueError(
                f"intensity: found {intensity.dtype} {intensity.shape}, expected float32 {self.shape}"
            )
        flat = np.ascontiguousarray(intensity).reshape(-1)
        if not all_positive(flat):
            lowest, highest = np.min(flat), np.max(flat)
            raise ValueError(
                f"intensity: found values from {lowest} to {highest}, expected all finite and positive"
            )
        return flat
