"""How to train: the options, and what follows from them alone (device, precision, optimiser, rate)."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Literal

import torch
from torch import nn

from nl_env.config import choice, number

Optimiser = Literal["adamw", "nadam"]
Schedule = Literal["cosine", "constant"]
Precision = Literal["auto", "bf16", "off"]
Device = Literal["auto", "cpu", "cuda"]


@dataclass(frozen=True)
class TrainingOptions:
    """How a network is trained. Invalid values raise ``ValueError``."""

    epochs: float = 20.0
    """Passes over the training samples."""
    steps: int = 0
    """Batches in all; above 0 it replaces ``epochs``."""
    batch_size: int = 16
    """Samples per step; every batch is full."""
    learning_rate: float = 1e-3
    """At its highest."""
    weight_decay: float = 1e-4
    """Decoupled with adamw, L2 with nadam."""
    optimiser: Optimiser = "adamw"
    """adamw, or nadam as the paper."""
    schedule: Schedule = "cosine"
    """cosine down to ``final_rate``, or constant."""
    warmup_steps: int = 0
    """Steps over which the rate rises linearly."""
    final_rate: float = 0.001
    """Last learning rate of the cosine, as a share of ``learning_rate``."""
    clip_gradient: float = 0.0
    """Largest gradient norm; 0 does not clip."""
    ema: float = 0.0
    """Decay of a running average of the weights, which is then evaluated and kept as best; 0 keeps none."""
    seed: int = 0
    """Of the sample order, the augmentation and dropout."""
    amp: Precision = "auto"
    """Forward pass in bf16 (off: fp32); auto: where the processor has it."""
    channels_last: bool = True
    """Images in NHWC order in memory, which convolutions prefer."""
    device: Device = "auto"
    """cpu or cuda; auto: CUDA where there is one."""
    threads: int = 0
    """CPU threads of PyTorch; 0 leaves its setting. Another number gives weights that differ by rounding."""
    loader_workers: int = 0
    """Processes that make batches; 0 makes them in a thread of this one."""
    evaluate_every: int = 0
    """Steps between validations; 0 validates at the end only."""
    patience: int = 0
    """Validations without a better one after which training stops; 0 never stops early."""
    checkpoint_every: int = 200
    """Steps between checkpoints."""
    log_every: int = 20
    """Steps between lines of the log."""

    def __post_init__(self) -> None:
        choice("optimiser", self.optimiser, ("adamw", "nadam"))
        choice("schedule", self.schedule, ("cosine", "constant"))
        choice("amp", self.amp, ("auto", "bf16", "off"))
        choice("device", self.device, ("auto", "cpu", "cuda"))
        number("epochs", self.epochs, 0 if self.steps else 1e-6, 1e6)
        number("learning_rate", self.learning_rate, 0, 10)
        number("weight_decay", self.weight_decay, 0, 10)
        number("final_rate", self.final_rate, 0, 1)
        number("clip_gradient", self.clip_gradient, 0, math.inf)
        number("ema", self.ema, 0, 1 - 1e-9)
        for name in ("batch_size", "checkpoint_every", "log_every"):
            number(name, getattr(self, name), 1, 10**9)
        for name in (
            "steps",
            "warmup_steps",
            "threads",
            "loader_workers",
            "evaluate_every",
            "patience",
            "seed",
        ):
            number(name, getattr(self, name), 0, 2**63)

    def total_steps(self, size: int) -> int:
        """Batches in all, for ``size`` training samples."""
        return self.steps or max(1, round(self.epochs * size / self.batch_size))

    def rate(self, step: int, total: int) -> float:
        """Learning rate of step ``step`` (from 0) of ``total``."""
        warm = min(1.0, (step + 1) / self.warmup_steps) if self.warmup_steps else 1.0
        if self.schedule == "constant":
            return self.learning_rate * warm
        falling = 0.5 * (1 + math.cos(math.pi * step / total))
        return self.learning_rate * warm * (self.final_rate + (1 - self.final_rate) * falling)


FREE_TO_CHANGE = ("device", "threads", "loader_workers", "log_every", "checkpoint_every")
"""Options that a resumed run may set anew; the first two change the weights by rounding."""


def resolve_device(name: Device) -> torch.device:
    """The device behind an option.

    Raises:
        ValueError: CUDA is asked for and there is none.
    """
    present = torch.cuda.is_available()
    if name == "cuda" and not present:
        raise ValueError("device: found 'cuda', expected cpu or auto where PyTorch sees no CUDA device")
    return torch.device("cuda" if name == "cuda" or (name == "auto" and present) else "cpu")


def uses_bf16(amp: Precision, device: torch.device) -> bool:
    """Whether the forward pass runs in bf16; "auto" asks for hardware that multiplies it."""
    if amp != "auto":
        return amp == "bf16"
    if device.type == "cuda":
        return torch.cuda.is_bf16_supported()
    has_bf16 = getattr(torch.cpu, "_is_avx512_bf16_supported", None)  # PyTorch has no public query
    return bool(has_bf16 and has_bf16())


def make_optimiser(options: TrainingOptions, model: nn.Module) -> torch.optim.Optimizer:
    """The optimiser over the parameters of ``model`` that are trained."""
    parameters = [parameter for parameter in model.parameters() if parameter.requires_grad]
    rate, decay = options.learning_rate, options.weight_decay
    if options.optimiser == "nadam":
        return torch.optim.NAdam(parameters, lr=rate, weight_decay=decay, foreach=True)
    return torch.optim.AdamW(parameters, lr=rate, weight_decay=decay, foreach=True)


@contextmanager
def seeded(seed: int) -> Iterator[None]:
    """Inside, PyTorch draws from ``seed`` (first weights, dropout); its own generator is left as it was."""
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        yield
