"""The networks of our extrapolator as one file of weights with its card."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray
from torch import nn

from nl_env.depth.motion_network import MotionNetwork
from nl_env.depth.refine import BlockConvolutions, RefineNetwork
from nl_env.depth.refine_blocks import RefinementInBlocks
from nl_env.depth.runtime import NetworkRunner
from nl_env.weight_files import load_network

ARCHITECTURE = "motion-warp-refine"
"""Name of ours on cards."""


class LearnedNetworks(nn.Module):
    """Both networks, and what has to be known to run them as they were trained.

    Args:
        motion: options of :class:`MotionNetwork`; None continues the last interval's motion.
        refine: options of :class:`RefineNetwork`; None leaves the warped frame as it is.
        threshold: logit from which there is a return.
        warped: False for a refinement that was trained on frames that are not warped.
        events: False for networks that were trained without events.
    """

    def __init__(
        self,
        motion: Mapping[str, Any] | None,
        refine: Mapping[str, Any] | None,
        threshold: float = 0.0,
        warped: bool = True,
        events: bool = True,
    ) -> None:
        super().__init__()
        self.motion = None if motion is None else MotionNetwork(**motion)
        self.refine = None if refine is None else RefineNetwork(**refine)
        self.threshold, self.warped, self.events = threshold, warped, events


def load_learned(path: Path) -> LearnedNetworks:
    """The networks in a file of weights, in evaluation mode.

    Raises:
        FileNotFoundError: no weights there, or no card beside them.
        ValueError: weights of something else, or damaged ones; the message names the file.
    """
    network, _ = load_network(path, {ARCHITECTURE: LearnedNetworks})
    return cast(LearnedNetworks, network)


def run_refinement(
    network: RefineNetwork,
    runtime: str = "auto",
    *,
    threads: int | None = None,
    precision: str | None = None,
) -> Callable[[NDArray[np.float32]], tuple[NDArray[np.float32], ...]]:
    """``network`` from arrays to arrays, as fast as the runtime allows; what it gives pickles.

    OpenVINO and ONNX Runtime run the convolutions alone where that is possible
    (:mod:`nl_env.depth.refine_blocks`); the answers are the same but for rounding.

    Args: as :class:`nl_env.depth.runtime.NetworkRunner`.
    """
    if runtime in ("openvino", "onnxruntime") and network.heads == 3 and network.fine is None:
        convolutions = NetworkRunner(
            BlockConvolutions(network), runtime, threads=threads, precision=precision
        )
        return RefinementInBlocks(convolutions, threads)
    return NetworkRunner(network, runtime, threads=threads, precision=precision)
