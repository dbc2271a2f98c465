"""What the training of keyframe detectors consists of: windows of slices, loss, validation, thresholds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from agents.keyframe_cnn import KeyframeCNN, average_down, block_length, probability
from agents.keyframe_data import FrameSource, MappedSlices
from agents.keyframe_networks import Detector, TemporalDetector
from nl_env.classification import (
    Detection,
    auroc,
    best_f1_threshold,
    even_threshold,
    matching_threshold,
    rate_threshold,
)
from nl_env.config import number
from nl_env.training.task import Forward

RATE_HZ = 41.0
"""Mean effective rate that the second calibrated threshold keeps to (the paper's rule gives 40.6 Hz)."""


CELL_WEIGHT = 4.0
"""Weight of the cells' loss against the motions'."""
MIRRORED_MOTION = np.array([1, -1], np.float32)
"""In a mirror the ego drives as fast and turns the other way."""


@dataclass(frozen=True)
class SampleOptions:
    """Which slices are learnt from, and how. Invalid values raise ``ValueError``."""

    window: int = 1
    """Successive slices per sample; more than 1 only helps a detector with a memory."""
    stride: int = 3
    """Slices between the starts of samples; each start moves by up to a stride at random."""
    cause_weight: float = 0.5
    """Weight of the loss of the causes, for detectors that name them."""
    new_weight: float = 2.0
    """Weight of slices with a new actor, which are rare."""
    flip: bool = True
    """Mirror half of the samples left to right."""
    invert: bool = True
    """Swap the polarities of half of the samples."""
    noise: float = 0.01
    """Up to this share of pixels gets an event of random sign, in half of the samples."""

    def __post_init__(self) -> None:
        number("window", self.window, 1, 10_000)
        number("stride", self.stride, 1, 10_000)
        number("cause_weight", self.cause_weight, 0.0, 100.0)
        number("new_weight", self.new_weight, 0.0, 100.0)
        number("noise", self.noise, 0.0, 1.0)


class KeyframeTask:
    """Learn the keyframe label; see ``nl_env.training.Task``.

    A sample is a window of successive slices of one sequence. A detector with a memory starts each window
    with an empty one.

    Args:
        training, validation: data.
        options: how samples are drawn.

    Attributes:
        labels: ``(sequences, K, 4)`` uint8, label and causes of all training slices, or ``(sequences, K, 1)``
            where causes are not known.
    """

    criterion = "ranking_error"

    def __init__(self, training: FrameSource, validation: FrameSource, options: SampleOptions) -> None:
        if training.shape != validation.shape:
            raise ValueError(f"validation: found frames {validation.shape}, expected {training.shape}")
        if training.length < options.window:
            raise ValueError(
                f"window: found {options.window}, expected at most {training.length}, a sequence's slices"
            )
        self.training = training
        self.validation = validation
        self.options = options
        starts = training.length - options.window + 1
        self._per_sequence = -(-starts // options.stride)
        self.labels = np.stack([labels_of(training, number) for number in range(len(training))])

    @property
    def size(self) -> int:
        """Number of samples."""
        return len(self.training) * self._per_sequence

    def batch(self, indices: NDArray[np.int64], rng: np.random.Generator) -> Sequence[NDArray[Any]]:
        """Frames ``(N, T, H, W)`` int8 and ``(N, T, 4)`` uint8, label and causes, or ``(N, T, 1)``."""
        frames, labels = [], []
        for index in indices:
            sequence, window = self.window(int(index), rng)
            frames.append(augment(self.training.frames(sequence)[window], rng, self.options))
            labels.append(self.labels[sequence, window])
        return np.stack(frames), np.stack(labels)

    def window(self, index: int, rng: np.random.Generator) -> tuple[int, slice]:
        """Sequence and slices of sample ``index``."""
        options = self.options
        sequence, within = divmod(index, self._per_sequence)
        start = within * options.stride + int(rng.integers(options.stride))
        start = min(start, self.training.length - options.window)
        return sequence, slice(start, start + options.window)

    def loss(self, model: Forward, batch: tuple[Tensor, ...]) -> tuple[Tensor, dict[str, Tensor]]:
        """Binary cross entropy of the label, and of the causes where the detector names them."""
        return cross_entropy(model(batch[0].float()), batch[1].float(), self.options)

    def evaluate(self, model: nn.Module) -> dict[str, float]:
        """On all validation slices: 1 - AUROC decides, because thresholds are chosen afterwards."""
        assert isinstance(model, Detector)
        found = detect(model, self.validation)
        return judged(
            np.concatenate([detection.scores for detection in found]),
            np.concatenate([detection.keyframe for detection in found]),
        )


class PerceptionTask:
    """Learn the first half of a :class:`TemporalDetector`: where near actors are, and how the ego moves.

    Args:
        training, validation: data.
        options: of single slices; ``window`` must be 1.
    """

    criterion = "loss"

    def __init__(self, training: MappedSlices, validation: MappedSlices, options: SampleOptions) -> None:
        if options.window != 1:
            raise ValueError(f"window: found {options.window}, expected 1: frames are looked at one by one")
        self._windows = KeyframeTask(training, validation, options)
        self.training = training
        self.validation = validation
        self.options = options

    @property
    def size(self) -> int:
        """Number of samples."""
        return self._windows.size

    def batch(self, indices: NDArray[np.int64], rng: np.random.Generator) -> Sequence[NDArray[Any]]:
        """Frames ``(N, H, W)`` int8, maps ``(N, ranges, rows, columns)`` bool and motions ``(N, 2)``."""
        frames, maps, motions = [], [], []
        options = replace(self.options, flip=False)
        for index in indices:
            sequence, window = self._windows.window(int(index), rng)
            row = self.training.sequence(sequence)[window.start]
            frame, covered, motion = row["frame"], row["actors"], row["motion"]
            if self.options.flip and rng.random() < 0.5:
                frame, covered, motion = frame[:, ::-1], covered[..., ::-1], motion * MIRRORED_MOTION
            frames.append(augment(frame, rng, options))
            maps.append(covered)
            motions.append(motion)
        return np.stack(frames), np.stack(maps), np.stack(motions)

    def loss(self, model: Forward, batch: tuple[Tensor, ...]) -> tuple[Tensor, dict[str, Tensor]]:
        """Cross entropy of the cells and smooth L1 of the motions."""
        frames, maps, motions = batch[0].float(), batch[1].float(), batch[2]
        covered, moving = model(frames)
        cells = functional.binary_cross_entropy_with_logits(covered, maps)
        motion = functional.smooth_l1_loss(moving, motions, beta=0.1)
        return CELL_WEIGHT * cells + motion, {"cells": cells, "motion": motion}

    @torch.no_grad()
    def evaluate(self, model: nn.Module) -> dict[str, float]:
        """The loss on every fourth validation slice, and the AUROC of the cells of the nearest actors."""
        device = next(model.parameters()).device
        losses, scores, truths = [], [], []
        for sequence in range(len(self.validation)):
            rows = self.validation.sequence(sequence)[::4]
            arrays = (rows["frame"], rows["actors"], rows["motion"])
            batch = tuple(torch.from_numpy(np.ascontiguousarray(array)).to(device) for array in arrays)
            losses.append(float(self.loss(model, batch)[0]))
            scores.append(model(batch[0].float())[0][:, 0].cpu().numpy().ravel())
            truths.append(rows["actors"][:, 0].ravel())
        return {
            self.criterion: float(np.mean(losses)),
            "auroc_cells": auroc(np.concatenate(scores), np.concatenate(truths)),
        }


class RecallTask:
    """Learn the second half of a :class:`TemporalDetector` from what its first half sees.

    Every training frame is looked at once, as it is and mirrored; long windows then cost little.

    Args:
        network: with a trained first half.
        training, validation: data.
        options: windows and weights; of the augmentations, ``flip`` alone applies.
    """

    criterion = KeyframeTask.criterion

    def __init__(
        self,
        network: TemporalDetector,
        training: FrameSource,
        validation: FrameSource,
        options: SampleOptions,
    ) -> None:
        self.options = options
        self._windows = KeyframeTask(training, validation, options)
        self._seen = [look(network, training, mirrored) for mirrored in (False, True)[: 1 + options.flip]]
        self._validation = torch.from_numpy(look(network, validation))
        self._truth = np.concatenate([labels_of(validation, n)[:, 0] for n in range(len(validation))]) > 0

    @property
    def size(self) -> int:
        """Number of samples."""
        return self._windows.size

    def batch(self, indices: NDArray[np.int64], rng: np.random.Generator) -> Sequence[NDArray[Any]]:
        """Summaries ``(N, T, S)`` float32 and ``(N, T, 4)`` uint8: the label and its causes."""
        seen, labels = [], []
        for index in indices:
            sequence, window = self._windows.window(int(index), rng)
            seen.append(self._seen[int(rng.integers(len(self._seen)))][sequence, window])
            labels.append(self._windows.labels[sequence, window])
        return np.stack(seen), np.stack(labels)

    def loss(self, model: Forward, batch: tuple[Tensor, ...]) -> tuple[Tensor, dict[str, Tensor]]:
        """As :meth:`KeyframeTask.loss`."""
        return cross_entropy(model(batch[0]), batch[1].float(), self.options)

    @torch.no_grad()
    def evaluate(self, model: nn.Module) -> dict[str, float]:
        """As :meth:`KeyframeTask.evaluate`."""
        logits = model(self._validation.to(next(model.parameters()).device)).cpu().numpy()
        return judged(probability(logits[..., 0].reshape(-1)), self._truth)


def cross_entropy(logits: Tensor, labels: Tensor, options: SampleOptions) -> tuple[Tensor, dict[str, Tensor]]:
    """Binary cross entropy of the label, and of the causes where the logits ``(N, T, 1 or 4)`` name them."""
    known = labels.shape[-1] > 1
    weights = 1 + (options.new_weight - 1) * labels[..., -1] if known else None
    label = functional.binary_cross_entropy_with_logits(logits[..., 0], labels[..., 0], weights)
    if logits.shape[-1] == 1 or not known or not options.cause_weight:
        return label, {}
    causes = functional.binary_cross_entropy_with_logits(logits[..., 1:], labels[..., 1:])
    return label + options.cause_weight * causes, {"label": label, "causes": causes}


def judged(scores: NDArray[np.floating], truth: NDArray[np.bool_]) -> dict[str, float]:
    """What validation reports of probabilities ``(n,)``."""
    certainty = np.clip(np.where(truth, scores, 1 - scores), 1e-7, 1)
    return {
        KeyframeTask.criterion: 1 - auroc(scores, truth),
        "cross_entropy": float(-np.log(certainty).mean()),
    }


def labels_of(data: FrameSource, number: int) -> NDArray[np.uint8]:
    """``(K, 4)``: the label and its causes, for every slice of a sequence; ``(K, 1)`` without causes."""
    causes = data.causes(number)
    if causes.shape[1] == 1:
        return causes.astype(np.uint8)
    return np.concatenate([causes.any(axis=1, keepdims=True), causes], axis=1).astype(np.uint8)


def look(network: TemporalDetector, data: FrameSource, mirrored: bool = False) -> NDArray[np.float32]:
    """What the network's first half sees, ``(sequences, K, S)``; in evaluation mode, on its device.

    Frames of another size are averaged down to the network's.
    """
    device = next(network.parameters()).device
    network.eval()
    seen = []
    with torch.inference_mode():
        for number in range(len(data)):
            frames = data.frames(number)
            length = block_length(data.shape)
            for start in range(0, len(frames), length):
                block = average_down(frames[start : start + length], network.size)
                block = np.ascontiguousarray(block[..., :: -1 if mirrored else 1])
                perceived = network.perceive(torch.from_numpy(block).to(device))
                seen.append(network.summarise(*perceived).cpu().numpy())
    return np.concatenate(seen).reshape(len(data), data.length, -1)


def augment(frames: NDArray[np.int8], rng: np.random.Generator, options: SampleOptions) -> NDArray[np.int8]:
    """A window ``(T, H, W)``, perhaps mirrored, inverted and with noise events; may be the given array."""
    if options.flip and rng.random() < 0.5:
        frames = frames[..., ::-1]
    if options.invert and rng.random() < 0.5:
        frames = -frames  # stored within +-127, so the negative fits
    if options.noise and rng.random() < 0.5:
        frames = np.array(frames)
        count = int(rng.uniform(0, options.noise) * frames.size)
        signs = rng.choice(np.array([-1, 1], np.int8), count)
        places = rng.integers(frames.size, size=count)
        flat = frames.reshape(-1)
        flat[places] = np.clip(flat[places], -126, 126) + signs
    return frames


def detect(network: Detector, data: FrameSource, threads: int | None = None) -> list[Detection]:
    """The detector's probabilities on every sequence; ``threads`` as PyTorch has them by default."""
    policy = KeyframeCNN(network, threads=threads or torch.get_num_threads())
    found = []
    for sequence, (seed, weather) in enumerate(zip(data.seeds, data.weathers, strict=True)):
        scores = policy.score_sequence(data.frames(sequence))
        found.append(Detection(seed, weather, scores, data.causes(sequence), data.lidar(sequence)))
    return found


def calibrate(detections: Sequence[Detection], rate_hz: float = RATE_HZ) -> dict[str, float]:
    """Thresholds for a card.

    ``f1`` has the best F1; ``rate`` keeps the mean effective rate to ``rate_hz``; ``even`` finds as large a
    share of the keyframes as it leaves alone of the other slices; ``matching`` triggers as often as there are
    keyframes, and is the ``default``.
    """
    matching = matching_threshold(detections)
    return {
        "f1": best_f1_threshold(detections),
        "rate": rate_threshold(detections, rate_hz),
        "even": even_threshold(detections),
        "matching": matching,
        "default": matching,
    }
