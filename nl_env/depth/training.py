"""What the extrapolation networks are trained for: tasks of the engine in :mod:`nl_env.training`.

Of ours, the motion network comes first. Its estimates for all pairs are then computed once, and the
refinement network learns from frames warped with them, with the true and with the continued motion, so
that it neither trusts a motion blindly nor wastes a good one.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from nl_env.config import number
from nl_env.depth.examples import Augmentation, Example, PairSource, augmented
from nl_env.depth.features import LOG_CENTRE, LOG_SCALE, NEAREST, coarse_camera
from nl_env.depth.metrics import METRIC_NAMES, full_metrics, paper_metrics
from nl_env.depth.motion import se3_log
from nl_env.depth.motion_network import cell_inverse, flow_jacobian, solve_twist
from nl_env.depth.refine import RETURN, WARPED
from nl_env.depth.refine_answer import depth_frames
from nl_env.depth.twist import corrected, drift
from nl_env.training import Forward

DECISIVE = ("log_mae", "imae", "bad_25", "rmse")
"""Metrics whose mean share of Repeat's chooses the best weights."""

_FLOW_UNIT = 0.1
"""px; flow errors below count in proportion, far larger ones by their logarithm."""

Prediction = tuple[NDArray[np.float32], NDArray[np.float32]]
"""Depth frame, and depth if there were a return."""


class MotionTask:
    """Training of the motion network: the flow that its correction leaves over.

    Args:
        pairs: to learn from.
        validation: to judge by.
        augmentation: as it says.
        events: False hides the events.
        every: judge by every so many validation pairs.
    """

    criterion = "left_over"

    def __init__(
        self,
        pairs: PairSource,
        validation: PairSource,
        augmentation: Augmentation | None = None,
        events: bool = True,
        every: int = 1,
    ) -> None:
        self.pairs, self.validation, self.events, self.every = pairs, validation, events, every
        self.augmentation = augmentation or Augmentation()

    @property
    def size(self) -> int:
        """Number of training pairs."""
        return len(self.pairs)

    def batch(self, indices: NDArray[np.int64], rng: np.random.Generator) -> tuple[NDArray[np.float32], ...]:
        """Features ``(N, C, H, W)``, drifts ``(N, 5, h, w)``, corrections ``(N, 6)``, gaps ``(N,)`` s."""
        return self._arrays(
            [augmented(self.pairs.example(int(index)), self.augmentation, rng) for index in indices]
        )

    def loss(self, model: Forward, batch: tuple[Tensor, ...]) -> tuple[Tensor, dict[str, Tensor]]:
        """The flow left over by the solved motion, and what it was before."""
        stack, drifts, twist, gap = batch
        errors = self._errors(model(stack), stack, drifts, twist, gap)
        left, before = (torch.log1p(each / _FLOW_UNIT).mean() for each in errors)
        return left, {"left_over": left, "before": before}

    def evaluate(self, model: nn.Module) -> dict[str, float]:
        """Mean flow in pixels that the correction leaves over, and what it was before."""
        errors = []
        for index in range(0, len(self.validation), self.every):
            batch = map(torch.from_numpy, self._arrays([self.validation.example(index)]))
            stack, drifts, twist, gap = batch
            both = self._errors(model(stack), stack, drifts, twist, gap)
            errors.append([error.item() for error in both])
        (left, before), (median, median_before) = np.mean(errors, axis=0), np.median(errors, axis=0)
        return {
            "left_over": float(left),
            "before": float(before),
            "median": float(median),
            "median_before": float(median_before),
        }

    def _arrays(self, chosen: Sequence[Example]) -> tuple[NDArray[np.float32], ...]:
        coarse = [replace(each, scene=each.scene.coarse()) for each in chosen]
        twists = [se3_log(each.true_motion @ np.linalg.inv(each.motion)) for each in coarse]
        stacks = [each.stack(self.events, compensated=True) for each in coarse]
        return (
            np.stack(stacks),
            np.stack([drift(stack) for stack in stacks]),
            np.array(twists, np.float32),
            np.array([each.scene.gap for each in coarse], np.float32),
        )

    def _errors(
        self, answer: Tensor, stack: Tensor, drifts: Tensor, twist: Tensor, gap: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Mean flow per image, px, that is left over, and without any correction."""
        jacobian = flow_jacobian(coarse_camera(self.pairs.camera), cell_inverse(stack))
        wanted = _flow(jacobian, twist)
        solved = _flow(jacobian, solve_twist(answer, drifts, jacobian, gap))
        return (wanted - solved).abs().sum(-1).mean((1, 2)), wanted.abs().sum(-1).mean((1, 2))


def estimated_motions(
    model: Callable[[Tensor], Tensor], pairs: PairSource, events: bool = True
) -> NDArray[np.float64]:
    """The motion over the gap of every pair as the motion network has it, ``(len(pairs), 4, 4)``."""
    motions = np.empty((len(pairs), 4, 4))
    with torch.inference_mode():
        for index in range(len(pairs)):
            chosen = pairs.example(index)
            chosen = replace(chosen, scene=chosen.scene.coarse())
            stack = chosen.stack(events, compensated=True)
            answer = model(torch.from_numpy(stack)[None])[0].numpy()
            motions[index] = corrected(chosen.motion, answer, stack, chosen.scene.camera, chosen.scene.gap)
    return motions


@dataclass(frozen=True)
class RefineLoss:
    """Weights of the parts of the refinement loss. Invalid values raise ``ValueError``."""

    returned: float = 0.3
    """Cross entropy of "there is a return", beside the log depth's absolute error (1)."""
    log_if_return: float = 0.3
    """Absolute error of the log depth if there is a return, where there is one."""
    metres_if_return: float = 0.1
    """Its error in metres: squared up to ``knee``, absolute beyond."""
    knee: float = 50.0
    """m."""
    inverse: float = 4.0
    """Absolute error of inverse depth (1/m) everywhere, "no return" being 0: near surfaces count most."""
    gates: float = 0.2
    """Cross entropy of either gate: open exactly where the warped frame is wrong."""
    changes: float = 0.1
    """Absolute error of either log depth with an open gate, where the warped frame is wrong."""
    wrong: float = 0.1
    """From this error of log depth on a pixel of the warped frame is wrong. Where nearly all pixels are
    right, the total error alone would teach the network to leave everything as it is."""

    def __post_init__(self) -> None:
        for name in ("returned", "log_if_return", "metres_if_return", "inverse", "gates", "changes"):
            number(name, getattr(self, name), 0, 100)
        number("knee", self.knee, 1e-3, 1e3)
        number("wrong", self.wrong, 0, 1e3)


@dataclass(frozen=True)
class MotionMix:
    """Which motion warps a training example. What is left of 1 goes to the motion network's estimate."""

    true: float = 0.2
    """Probability of the true one."""
    continued: float = 0.2
    """Probability of the last interval's, continued."""

    def __post_init__(self) -> None:
        number("true", self.true, 0, 1)
        number("continued", self.continued, 0, 1 - self.true)


@dataclass(frozen=True)
class Motions:
    """Estimates of :func:`estimated_motions` for training and validation."""

    training: NDArray[np.float64]
    validation: NDArray[np.float64]


class RefineTask:
    """Training of the refinement network.

    Args:
        pairs: to learn from.
        validation: to judge by.
        motions: estimates for both; None continues the motion where an estimate would be used.
        augmentation, weights, mix: as they say.
        events: False hides the events.
        odometry: only true motions.
        warped: False learns from frames that are not warped at all.
        every: judge by every so many validation pairs.
    """

    criterion = "score"

    def __init__(
        self,
        pairs: PairSource,
        validation: PairSource,
        motions: Motions | None = None,
        *,
        augmentation: Augmentation | None = None,
        weights: RefineLoss | None = None,
        mix: MotionMix | None = None,
        events: bool = True,
        odometry: bool = False,
        warped: bool = True,
        every: int = 1,
    ) -> None:
        self.pairs, self.validation, self.motions = pairs, validation, motions
        self.augmentation = augmentation or Augmentation()
        self.weights, self.mix = weights or RefineLoss(), mix or MotionMix()
        self.events, self.odometry, self.warped, self.every = events, odometry, warped, every

    @property
    def size(self) -> int:
        """Number of training pairs."""
        return len(self.pairs)

    def batch(self, indices: NDArray[np.int64], rng: np.random.Generator) -> tuple[NDArray[np.float32], ...]:
        """Features ``(N, C, H, W)`` and the truth ``(N, H, W)`` m."""
        chosen = [
            augmented(self._training_example(int(index), rng.uniform()), self.augmentation, rng)
            for index in indices
        ]
        stacks = [self._unwarped(each).stack(self.events) for each in chosen]
        return np.stack(stacks), np.stack([each.truth for each in chosen])

    def loss(self, model: Forward, batch: tuple[Tensor, ...]) -> tuple[Tensor, dict[str, Tensor]]:
        """Log depth everywhere, whether there is a return, and depth where there is one."""
        stack, truth = batch
        code, logit, code_if, free, gate, free_if, gate_if = model(stack).unbind(1)
        weights, far = self.weights, self.pairs.max_depth
        valid = truth > 0
        log_truth = torch.where(valid, truth.clamp(min=NEAREST), far).log()
        log_if = _log_depth(code_if)
        metres_if = log_if.clamp(max=float(np.log(2 * far))).exp()
        wrong = (_log_depth(stack[:, WARPED]) - log_truth).abs() > weights.wrong
        wrong_if = valid & (wrong | (stack[:, RETURN] == 0))
        cross_entropy = functional.binary_cross_entropy_with_logits
        log_depth = _log_depth(code).clamp(max=float(np.log(far)))
        errors = {
            "log_depth": (log_depth - log_truth).abs().mean(),
            "inverse": ((-log_depth).exp() - (-log_truth).exp()).abs().mean(),
            "returned": cross_entropy(logit, valid.float()),
            "log_if_return": _mean((log_if - log_truth).abs(), valid),
            "metres_if_return": _mean(
                functional.smooth_l1_loss(metres_if, truth, reduction="none", beta=weights.knee), valid
            ),
            "gates": cross_entropy(gate, wrong.float())
            + _mean(cross_entropy(gate_if, wrong_if.float(), reduction="none"), valid),
            "changes": _mean((_log_depth(free) - log_truth).abs(), wrong)
            + _mean((_log_depth(free_if) - log_truth).abs(), wrong_if),
        }
        total = (
            errors["log_depth"]
            + weights.returned * errors["returned"]
            + weights.log_if_return * errors["log_if_return"]
            + weights.metres_if_return * errors["metres_if_return"]
            + weights.inverse * errors["inverse"]
            + weights.gates * errors["gates"]
            + weights.changes * errors["changes"]
        )
        return total, errors

    def evaluate(self, model: nn.Module) -> dict[str, float]:
        """Every metric as a share of Repeat's, and ``score``, the mean of the decisive ones."""

        def predict(index: int) -> Prediction:
            motion = None if self.motions is None else self.motions.validation[index]
            chosen = self._unwarped(self.validation.example(index, motion, odometry=self.odometry))
            answer = model(torch.from_numpy(chosen.stack(self.events))[None])[0].numpy()
            return depth_frames(answer, self.validation.max_depth)

        return scores(self.validation, predict, self.every)

    def _training_example(self, index: int, draw: float) -> Example:
        true = self.odometry or draw < self.mix.true
        if self.motions is None or draw < self.mix.true + self.mix.continued:
            return self.pairs.example(index, odometry=true)
        return self.pairs.example(index, self.motions.training[index], odometry=true)

    def _unwarped(self, chosen: Example) -> Example:
        return chosen if self.warped else standing(chosen)


def standing(chosen: Example) -> Example:
    """``chosen``, with the camera believed to stand still: nothing is warped."""
    return replace(chosen, scene=replace(chosen.scene, last_motion=np.eye(4)), motion=np.eye(4))


def scores(pairs: PairSource, predict: Callable[[int], Prediction], every: int = 1) -> dict[str, float]:
    """Errors of a method as shares of Repeat's, from means over the gaps.

    Args:
        pairs: with every gap as often as any other.
        predict: depth frame and depth if there were a return, of a pair's index.
        every: judge by every so many pairs.

    Returns:
        All metrics by name, and ``score``, the mean of the decisive ones.

    Raises:
        ValueError: ``every`` skips a gap altogether.
    """
    errors: dict[int, list[list[list[float]]]] = {}
    far = pairs.max_depth
    for index in range(0, len(pairs), every):
        depth, depth_if_return = predict(index)
        known = pairs.example(index)
        truth, prior = known.truth, known.scene.prior
        errors.setdefault(round(known.scene.gap * 1e6), []).append(
            [
                [*paper_metrics(depth_if_return, truth, far), *full_metrics(depth, truth, far)],
                [*paper_metrics(prior, truth, far), *full_metrics(prior, truth, far)],
            ]
        )
    if len(errors) < pairs.gaps:
        raise ValueError(
            f"every: found {every}, which meets {len(errors)} of {pairs.gaps} gaps only, "
            f"expected a number that shares no factor with {pairs.gaps}"
        )
    ours, repeat = np.mean([np.nanmean(np.array(rows), axis=0) for rows in errors.values()], axis=0)
    with np.errstate(divide="ignore", invalid="ignore"):  # an error of zero has no share
        shares = dict(zip(METRIC_NAMES, (ours / repeat).tolist(), strict=True))
    return {"score": float(np.mean([shares[name] for name in DECISIVE])), **shares}


def _flow(jacobian: Tensor, twist: Tensor) -> Tensor:
    """Flow ``(N, h, w, 2)`` of twists ``(N, 6)``."""
    return (jacobian @ twist[:, None, None, :, None])[..., 0]


def _log_depth(code: Tensor) -> Tensor:
    return code * LOG_SCALE + LOG_CENTRE


def _mean(values: Tensor, valid: Tensor) -> Tensor:
    return (values * valid).sum() / valid.sum().clamp(min=1)
