"""Networks that find keyframes: the paper's convolutional network, and one with a memory of past frames.

Both read event frames alone and answer with the logit of "keyframe". The first sees one slice, as in the
paper. The second carries a recurrent state from slice to slice, because what makes a keyframe (speed, a near
actor, an actor that was not there before) shows over several slices better than in one.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional

from nl_env.config import choice

INPUTS = ("raw", "polarity")
CAUSES = ("speed", "distance", "new")
"""Order of the causes of a keyframe, in the logits and in the data."""
RANGES = (8.0, 20.0)
"""m between outlines: actors within each are marked on a map of their own."""
MOTIONS = ("speed", "yaw_rate")
"""The ego's motion, in 10 m/s and in 0.5 rad/s."""
CELL = 8
"""Pixels along the side of a cell of the maps."""
POOLED = (5, 10)
"""Rows and columns of the maps as the memory sees them."""


class Detector(nn.Module):
    """What the policy and the training need of a network.

    Attributes:
        size: ``(H, W)`` of the event frames it was made for.
        memory_size: numbers it carries from slice to slice; 0 without a memory.
        outputs: logits per slice; the first says "keyframe", further ones name the causes.
    """

    size: tuple[int, int]
    memory_size: int
    outputs: int

    @abstractmethod
    def step(self, frames: Tensor, memory: Tensor) -> tuple[Tensor, Tensor]:
        """Logits ``(N, outputs)`` and the new memory for one slice of N sequences.

        Args:
            frames: ``(N, H, W)`` float32 signed event sums.
            memory: ``(N, memory_size)`` float32, zeros at the start of a sequence.
        """

    @abstractmethod
    def follow(self, frames: Tensor, memory: Tensor) -> tuple[Tensor, Tensor]:
        """As :meth:`step` for successive slices ``(N, T, H, W)``: logits ``(N, T, outputs)`` and memory."""

    def forward(self, frames: Tensor) -> Tensor:
        """Logits ``(N, T, outputs)`` of ``(N, T, H, W)`` successive slices from an empty memory."""
        return self.follow(frames, frames.new_zeros(len(frames), self.memory_size))[0]


class FrameDetector(Detector):
    """The paper's three-layer network, layer for layer and name for name as released.

    Average pooling by ``pool``, three 3x3 convolutions (16, 8 and 4 channels) with batch norm, leaky ReLU and
    max pooling, a hidden layer of 128 with dropout, one logit. Pooling rounds down, so any size will do.

    Args:
        height, width: of the event frames.
        pool: factor of the average pooling, 1 or 2 in the released code.
        inputs: ``"raw"`` is the released input, the signed sums in one channel. ``"polarity"`` compresses
            positive and negative sums by ``log(1 + x)`` in two channels, so that edges of both signs survive
            the pooling.
    """

    memory_size = 0
    outputs = 1

    def __init__(self, height: int = 120, width: int = 160, pool: int = 2, inputs: str = "polarity") -> None:
        super().__init__()
        choice("inputs", inputs, INPUTS)
        choice("pool", pool, (1, 2, 4))
        smallest = 8 * pool
        if height < smallest or width < smallest:
            raise ValueError(
                f"height, width: found {(height, width)}, expected at least {smallest} with pool={pool}"
            )
        self.size = (height, width)
        self.pool = pool
        self.inputs = inputs
        self.conv1 = nn.Conv2d(1 if inputs == "raw" else 2, 16, 3, padding=1)
        self.bn1 = nn.BatchNorm2d(16)
        self.conv2 = nn.Conv2d(16, 8, 3, padding=1)
        self.bn2 = nn.BatchNorm2d(8)
        self.conv3 = nn.Conv2d(8, 4, 3, padding=1)
        self.bn3 = nn.BatchNorm2d(4)
        self.fc1 = nn.Linear(4 * (height // pool // 8) * (width // pool // 8), 128)
        self.fc2 = nn.Linear(128, 1)
        self.dropout = nn.Dropout(0.3)

    def step(self, frames: Tensor, memory: Tensor) -> tuple[Tensor, Tensor]:
        x = frames[:, None] if self.inputs == "raw" else polarities(frames)
        x = functional.avg_pool2d(x, self.pool)
        for conv, norm in ((self.conv1, self.bn1), (self.conv2, self.bn2), (self.conv3, self.bn3)):
            x = functional.max_pool2d(functional.leaky_relu(norm(conv(x))), 2)
        x = self.dropout(functional.leaky_relu(self.fc1(x.flatten(1))))
        return self.fc2(x), memory

    def follow(self, frames: Tensor, memory: Tensor) -> tuple[Tensor, Tensor]:
        logits, _ = self.step(frames.flatten(0, 1), memory)
        return logits.unflatten(0, frames.shape[:2]), memory


class TemporalDetector(Detector):
    """Sees near actors and its own motion in every event frame, and remembers them with a recurrent unit.

    Its first half, :meth:`perceive`, looks at one frame: a map of the cells that actors within each of
    ``RANGES`` cover, and the ego's speed and yaw rate. It is trained on those; from the label alone it would
    learn its scenes by heart. Its second half, :meth:`recall`, sees nothing but these quantities, a hundred
    numbers per slice, and follows them over seconds: an actor that left the view is still near for a while.
    It answers with four logits, "keyframe" and the three causes.

    Frames are split by polarity and compressed as in :class:`FrameDetector`, then folded: each 2x2 block
    becomes one pixel of eight channels, so that no layer works at full size, where memory traffic would take
    the time, and no detail is averaged away.

    Args:
        height, width: of the event frames, multiples of 16.
        channels: of the three levels, at a quarter, an eighth and a sixteenth of the image's sides.
        hidden: size of the layer between the two halves.
        memory_size: size of the recurrent state.
    """

    outputs = 1 + len(CAUSES)

    def __init__(
        self,
        height: int = 120,
        width: int = 160,
        channels: Sequence[int] = (32, 48, 64),
        hidden: int = 64,
        memory_size: int = 64,
    ) -> None:
        super().__init__()
        if min(height, width) < 32 or height % CELL or width % CELL:
            raise ValueError(
                f"height, width: found {(height, width)}, expected multiples of {CELL}, at least 32"
            )
        if len(channels) != 3 or min(channels) < 1:
            raise ValueError(f"channels: found {channels!r}, expected three positive numbers")
        self.size = (height, width)
        self.memory_size = memory_size
        near, middle, far = channels
        self.quarter = _convolution(8, near, stride=2)
        self.eighth = nn.Sequential(_convolution(near, middle, stride=2), _convolution(middle, middle))
        self.sixteenth = nn.Sequential(_convolution(middle, far, stride=2), _convolution(far, far))
        self.context = nn.Conv2d(far, middle, 1)
        self.maps = nn.Conv2d(middle, len(RANGES), 1)
        self.motion = nn.Linear(2 * far, len(MOTIONS))
        seen = len(RANGES) * (POOLED[0] * POOLED[1] + 1) + len(MOTIONS)
        self.inputs = nn.Linear(seen, hidden)
        self.dropout = nn.Dropout(0.3)
        self.recurrent = nn.GRU(hidden, memory_size, batch_first=True)
        self.head = nn.Linear(hidden + memory_size, self.outputs)

    def perceive(self, frames: Tensor) -> tuple[Tensor, Tensor]:
        """What single frames ``(N, H, W)`` show.

        Returns:
            Logits ``(N, len(RANGES), H / 8, W / 8)`` of cells that actors cover, and ``(N, 2)`` of
            :data:`MOTIONS`.
        """
        eighth = self.eighth(self.quarter(functional.pixel_unshuffle(polarities(frames), 2)))
        sixteenth = self.sixteenth(eighth)
        context = functional.interpolate(self.context(sixteenth), size=eighth.shape[2:], mode="nearest")
        whole = torch.cat([sixteenth.mean((2, 3)), sixteenth.amax((2, 3))], dim=1)
        return self.maps(functional.relu(eighth + context)), self.motion(whole)

    def summarise(self, maps: Tensor, motion: Tensor) -> Tensor:
        """``(N, S)``: what :meth:`recall` sees of a frame, of the two answers of :meth:`perceive`."""
        covered = torch.sigmoid(maps)
        cells = functional.adaptive_avg_pool2d(covered, POOLED).flatten(1)
        return torch.cat([cells, covered.amax((2, 3)), motion], dim=1)

    def recall(self, seen: Tensor, memory: Tensor) -> tuple[Tensor, Tensor]:
        """Logits ``(N, T, 4)`` and memory after successive summaries ``(N, T, S)``."""
        x = self.dropout(functional.relu(self.inputs(seen)))
        remembered, last = self.recurrent(x, memory[None])
        return self.head(torch.cat([x, remembered], dim=2)), last[0]

    def step(self, frames: Tensor, memory: Tensor) -> tuple[Tensor, Tensor]:
        logits, memory = self.follow(frames[:, None], memory)
        return logits[:, 0], memory

    def follow(self, frames: Tensor, memory: Tensor) -> tuple[Tensor, Tensor]:
        seen = self.summarise(*self.perceive(frames.flatten(0, 1)))
        return self.recall(seen.unflatten(0, frames.shape[:2]), memory)


class Perception(nn.Module):
    """The first half of a :class:`TemporalDetector`, to train it alone."""

    def __init__(self, detector: TemporalDetector) -> None:
        super().__init__()
        self.detector = detector

    def forward(self, frames: Tensor) -> tuple[Tensor, Tensor]:
        """As ``perceive``."""
        return self.detector.perceive(frames)


class Recall(nn.Module):
    """The second half of a :class:`TemporalDetector`, to train it alone."""

    def __init__(self, detector: TemporalDetector) -> None:
        super().__init__()
        self.detector = detector

    def forward(self, seen: Tensor) -> Tensor:
        """Logits ``(N, T, 4)`` of successive summaries ``(N, T, S)``, from an empty memory."""
        return self.detector.recall(seen, seen.new_zeros(len(seen), self.detector.memory_size))[0]


def _convolution(inputs: int, outputs: int, stride: int = 1) -> nn.Sequential:
    return nn.Sequential(
        nn.Conv2d(inputs, outputs, 3, stride=stride, padding=1, bias=False),
        nn.BatchNorm2d(outputs),
        nn.ReLU(),
    )


def polarities(frames: Tensor) -> Tensor:
    """Signed sums ``(N, H, W)`` to ``log(1 + x)`` of the positive and the negative ones, ``(N, 2, H, W)``."""
    return torch.log1p(torch.stack([frames.clamp(min=0), frames.neg().clamp(min=0)], dim=1))


ARCHITECTURES: dict[str, Callable[..., nn.Module]] = {
    "keyframe-cnn": FrameDetector,
    "keyframe-cnn-temporal": TemporalDetector,
}
"""Names in the cards of weights."""
