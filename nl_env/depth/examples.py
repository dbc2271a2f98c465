"""Training examples: a pair as the networks see it, and changes that leave it true."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from nl_env.config import number
from nl_env.depth.features import GAP_UNIT, Scene, features, hide_events
from nl_env.depth.motion import se3_exp
from nl_env.depth.twist import SPREAD
from nl_env.types import Camera

_MIRROR = np.diag([-1.0, 1.0, 1.0, 1.0])


@dataclass(frozen=True)
class Augmentation:
    """Changes that leave a pair true. Invalid values raise ``ValueError``."""

    flip: float = 0.5
    """Probability of a mirrored pair (the principal point is central)."""
    noise: float = 0.005
    """At most this share of a voxel grid's counts gets a noise event."""
    threshold: float = 1.3
    """Counts are scaled by up to this factor or its inverse, as by another contrast threshold."""
    start: float = 0.03
    """Probability of a pair from the start of a sequence: no previous frame, no motion known."""
    jitter: float = 0.3
    """Motions are disturbed by up to this share of the continued motion's usual error."""

    def __post_init__(self) -> None:
        for name in ("flip", "noise", "start"):
            number(name, getattr(self, name), 0, 1)
        number("threshold", self.threshold, 1, 10)
        number("jitter", self.jitter, 0, 10)


@dataclass(frozen=True)
class Example:
    """A pair as the networks see it.

    Attributes:
        scene: what is known.
        motion: ``(4, 4)``, the motion over the gap as it is believed.
        true_motion: ``(4, 4)``, as it was; NaN where that is not known.
        truth: ``(H, W)`` float32 m.
    """

    scene: Scene
    motion: NDArray[np.float64]
    true_motion: NDArray[np.float64]
    truth: NDArray[np.float32]

    def stack(self, events: bool = True, compensated: bool = False) -> NDArray[np.float32]:
        """Features ``(C, H, W)``; without ``events``, as a camera without any would have them."""
        stack = features(self.scene, self.motion, compensated=compensated)
        return stack if events else hide_events(stack)


class PairSource(Protocol):
    """Pairs as the trainings take them; ``len`` says how many.

    Attributes:
        camera: intrinsics.
        max_depth: sensor range, m.
        gaps: how many different gaps, or groups of gaps, there are.
        poses: whether the true motions are known.
    """

    camera: Camera
    max_depth: float
    gaps: int
    poses: bool

    def __len__(self) -> int: ...

    def example(
        self, index: int, motion: NDArray[np.float64] | None = None, *, odometry: bool = False
    ) -> Example:
        """Pair ``index``.

        Args:
            index: which.
            motion: believed motion over the gap; default the last interval's, continued.
            odometry: believe the true motions instead, over the gap and over the last interval; raises
                ``ValueError`` where they are not known.
        """
        ...

    @property
    def summary(self) -> dict[str, Any]:
        """What they were made from, for cards: JSON-ready."""
        ...


def augmented(original: Example, options: Augmentation, rng: np.random.Generator) -> Example:
    """``original``, changed at random."""
    scene, motion, true_motion, truth = (
        original.scene,
        original.motion,
        original.true_motion,
        original.truth,
    )
    scale = options.jitter * rng.uniform() * scene.gap / GAP_UNIT
    motion = se3_exp(scale * rng.normal(size=6) * np.array(SPREAD)) @ motion
    if rng.uniform() < options.start:
        scene = replace(scene, previous=None, last_motion=np.eye(4))
        motion = np.eye(4)
    if rng.uniform() < options.flip:
        scene = replace(
            scene,
            prior=_mirrored(scene.prior),
            previous=None if scene.previous is None else _mirrored(scene.previous),
            last_motion=_MIRROR @ scene.last_motion @ _MIRROR,
            voxel=scene.voxel[:, :, ::-1],
        )
        truth = _mirrored(truth)
        motion, true_motion = _MIRROR @ motion @ _MIRROR, _MIRROR @ true_motion @ _MIRROR
    return Example(replace(scene, voxel=_noisy(scene.voxel, options, rng)), motion, true_motion, truth)


def _mirrored(image: NDArray[np.float32]) -> NDArray[np.float32]:
    return np.ascontiguousarray(image[:, ::-1])


def _noisy(
    voxel: NDArray[np.float32] | NDArray[np.int8], options: Augmentation, rng: np.random.Generator
) -> NDArray[np.float32]:
    """Counts under another contrast threshold, with some events of noise."""
    counts = voxel.astype(np.float32)
    flat = counts.reshape(-1)
    factor = np.float32(options.threshold ** rng.uniform(-1, 1))
    active = np.flatnonzero(flat)
    # Rounded up or down at random, so that no count is lost in the mean.
    flat[active] = np.floor(flat[active] * factor + rng.random(len(active), np.float32))
    events = int(options.noise * rng.uniform() * flat.size)
    flat[rng.integers(0, flat.size, events)] += rng.choice(np.array([-1, 1], np.float32), events)
    return counts
