"""Our extrapolator: estimate the motion, warp the last LiDAR frame, refine it.

Importing this module does not import PyTorch: the networks come as functions from arrays to arrays, from
whatever runtime executes them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from nl_env.depth.features import CHANNELS, Scene, features, hide_events
from nl_env.depth.motion import IntervalMotion
from nl_env.depth.refine_answer import depth_frames
from nl_env.depth.threads import usable_threads
from nl_env.depth.twist import corrected
from nl_env.depth.warp import warp
from nl_env.representations import voxel_from_bins
from nl_env.types import Extrapolation, ExtrapolationInput

Network = Callable[[NDArray[np.float32]], tuple[NDArray[np.float32], ...]]
"""A network in some runtime: a batch in, a batch out."""

MULTIPLE = 8
"""Image sides must be multiples of this."""


class MotionWarpRefine:
    """A :class:`nl_env.types.DepthExtrapolator` of up to three steps.

    Without ``motion`` the last interval's motion is continued; without ``refine`` the warped frame is the
    answer. What is estimated from the last two LiDAR frames is kept until another one arrives, and depends
    on them alone.

    Args:
        motion: the motion network, ``(1, C, H, W)`` features to ``(1, 2, H/4, W/4)``.
        refine: the refinement network, ``(n, C, H, W)`` features to ``(n, 3, H, W)``.
        threshold: logit from which there is a return.
        warped: False for a refinement that was trained on frames that are not warped.
        events: False for networks that were trained without events.
        odometry: take the true poses instead of estimating the motion.
        threads: of what surrounds the networks, at most; the default is that of a network. The frames do
            not depend on it.
    """

    history = 2

    def __init__(
        self,
        motion: Network | None,
        refine: Network | None,
        *,
        threshold: float = 0.0,
        warped: bool = True,
        events: bool = True,
        odometry: bool = False,
        threads: int | None = None,
    ) -> None:
        self.odometry = odometry
        self._threads = threads
        self._motion, self._refine = motion, refine
        self._threshold, self._warped, self._events = threshold, warped, events
        self._interval = IntervalMotion()

    def reset(self) -> None:
        """Forget the estimated motion."""
        self._interval = IntervalMotion()

    def __call__(self, inputs: ExtrapolationInput) -> Extrapolation:
        return self.batch([inputs])[0]

    def batch(self, inputs: Sequence[ExtrapolationInput]) -> list[Extrapolation]:
        """As :class:`nl_env.types.BatchExtrapolator`: one run of the refinement for all of them."""
        posed = [self._scene_and_corrected_motion(one) for one in inputs]
        if self._refine is None:
            return [Extrapolation(warp(s.prior, s.camera, motion, s.max_depth)) for s, motion in posed]
        if not self._warped:
            posed = [(replace(scene, last_motion=np.eye(4)), np.eye(4)) for scene, _ in posed]
        shape = inputs[0].camera.shape
        seen = np.empty((len(posed), len(CHANNELS), *shape), np.float32)
        for (scene, motion), stack in zip(posed, seen, strict=True):
            self._see(scene, motion, stack)
        (answers,) = self._refine(seen)
        threads = usable_threads(shape, self._threads)
        return [
            Extrapolation(*depth_frames(answer, one.max_depth, self._threshold, threads))
            for answer, one in zip(answers, inputs, strict=True)
        ]

    def _scene_and_corrected_motion(self, inputs: ExtrapolationInput) -> tuple[Scene, NDArray[np.float64]]:
        scene, motion = self._scene_and_motion(inputs)
        if self._motion is not None and self._warped and not self.odometry:
            motion = self._corrected(scene, motion)
        return scene, motion

    def _scene_and_motion(self, inputs: ExtrapolationInput) -> tuple[Scene, NDArray[np.float64]]:
        """What is known, and the motion over the gap before any correction."""
        height, width = inputs.camera.shape
        if height % MULTIPLE or width % MULTIPLE:
            raise ValueError(
                f"camera: found an image of {height}x{width}, expected sides that are multiples of {MULTIPLE}"
            )
        gap = (inputs.t - inputs.lidar_times[-1]) * 1e-6
        prior = inputs.lidar_frames[-1]
        previous = inputs.lidar_frames[-2] if len(inputs.lidar_frames) > 1 else None
        last = motion = np.eye(4)
        if self.odometry:
            *before, here, now = inputs.poses
            motion = np.linalg.inv(now) @ here
            if previous is not None:
                last = np.linalg.inv(here) @ before[-1]
        elif previous is not None:
            last = self._interval(previous, prior, inputs.camera, inputs.max_depth, self._threads)
            period = (inputs.lidar_times[-1] - inputs.lidar_times[-2]) * 1e-6
            motion = self._interval.continued(gap / period)
        voxel = voxel_from_bins(inputs.bins)
        return Scene(inputs.camera, inputs.max_depth, prior, previous, last, voxel, gap), motion

    def _corrected(self, scene: Scene, motion: NDArray[np.float64]) -> NDArray[np.float64]:
        """``motion`` as the events correct it; seen at about a quarter of the full resolution."""
        assert self._motion is not None
        coarse = scene.coarse()
        stack = np.empty((len(CHANNELS), *coarse.camera.shape), np.float32)
        self._see(coarse, motion, stack, compensated=True)
        (answer,) = self._motion(stack[None])
        return corrected(motion, answer[0], stack, coarse.camera, coarse.gap)

    def _see(
        self,
        scene: Scene,
        motion: NDArray[np.float64],
        stack: NDArray[np.float32],
        compensated: bool = False,
    ) -> None:
        """Fill ``stack`` with the features."""
        threads = usable_threads(scene.camera.shape, self._threads)
        features(scene, motion, compensated=compensated, threads=threads, out=stack)
        if not self._events:
            hide_events(stack)
