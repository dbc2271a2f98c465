"""The depth frame that the consumer holds and how far it is off, computed from the sensors."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from nl_env.depth.metrics import all_metrics
from nl_env.history import SensorHistory
from nl_env.types import DepthExtrapolator, Extrapolation, Sample, SensorStream


class HeldDepth(Protocol):
    """Answers every decision of an environment with the errors of the depth it leads to.

    Attributes:
        depth: ``(H, W)`` float32 m, the held depth frame; not a copy.
        prior: ``(H, W)`` float32 m, the last LiDAR frame; not a copy.
    """

    @property
    def depth(self) -> NDArray[np.float32]: ...

    @property
    def prior(self) -> NDArray[np.float32]: ...

    def start(self) -> None:
        """Forget the previous sequence."""
        ...

    def settle(self, sample: Sample, triggered: bool, age: int) -> Mapping[str, float]:
        """Make or hold the depth of ``sample``'s slice and score it.

        Args:
            sample: of the slice acted on.
            triggered: extrapolate a new frame.
            age: slices since the frame that is then held was made.

        Returns:
            Every metric by name.
        """
        ...


class ComputedDepth:
    """Runs the extrapolator where the agent triggers and compares with the true depth.

    Args:
        stream: sensors whose samples are settled.
        extrapolator: makes the frames of triggered slices.
        min_depth: depths below are read as this one by the full-image metrics, m.
    """

    def __init__(self, stream: SensorStream, extrapolator: DepthExtrapolator, min_depth: float) -> None:
        self._camera, self._max_depth = stream.camera, stream.max_depth
        self._extrapolator = extrapolator
        self._min_depth = min_depth

    @property
    def depth(self) -> NDArray[np.float32]:
        """``(H, W)`` float32 m, the held depth frame; not a copy."""
        return self._held.depth

    @property
    def prior(self) -> NDArray[np.float32]:
        """``(H, W)`` float32 m, the last LiDAR frame; not a copy."""
        return self._history.prior

    def start(self) -> None:
        """Forget the previous sequence."""
        self._extrapolator.reset()
        self._history = SensorHistory(self._camera, self._max_depth, self._extrapolator)

    def settle(self, sample: Sample, triggered: bool, age: int) -> Mapping[str, float]:
        """Make or hold the depth of ``sample``'s slice and score it, as :class:`HeldDepth` says."""
        self._history.add(sample)
        if sample.lidar is not None:
            self._held = Extrapolation(sample.lidar)
        elif triggered:
            self._held = self._extrapolate(sample)
        return self._scores(sample)

    def _extrapolate(self, sample: Sample) -> Extrapolation:
        extrapolation = self._extrapolator(self._history.inputs(sample))
        if extrapolation.depth.shape != sample.depth.shape:
            raise ValueError(
                f"extrapolator: found depth of shape {extrapolation.depth.shape}, "
                f"expected {sample.depth.shape}"
            )
        return extrapolation

    def _scores(self, sample: Sample) -> Mapping[str, float]:
        """Both metric sets; the paper's, which ignore missing returns, use the depth if there were one."""
        held = self._held
        return all_metrics(held.depth, sample.depth, self._max_depth, self._min_depth, held.depth_if_return)
