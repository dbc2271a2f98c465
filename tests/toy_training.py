"""A small regression that is trained in a moment, for the tests of the engine.

python tests/toy_training.py FOLDER STEP   # trains in FOLDER and is killed in step STEP
"""

import os
import signal
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from torch import nn

from nl_env.training import TrainingOptions, seeded, train
from nl_env.weight_files import Card

CARD = Card(what="a toy", architecture="toy", options={"channels": 4})
OPTIONS = TrainingOptions(
    steps=24,
    batch_size=4,
    learning_rate=0.02,
    evaluate_every=3,
    checkpoint_every=5,
    log_every=4,
    ema=0.9,
    patience=50,
    seed=3,
    amp="off",
    device="cpu",
    threads=1,
    warmup_steps=4,
)


class Toy(nn.Module):
    """Convolution, batch norm, dropout, linear: everything that has a state of its own."""

    def __init__(self, channels=4):
        super().__init__()
        self.conv = nn.Conv2d(3, channels, 3, padding=1)
        self.norm = nn.BatchNorm2d(channels)
        self.dropout = nn.Dropout(0.3)
        self.head = nn.Linear(channels, 1)

    def forward(self, image):
        return self.head(self.dropout(self.norm(self.conv(image)).relu().mean((2, 3))))[:, 0]


class ToyTask:
    """Learn how bright a noisy image is."""

    size = 18
    criterion = "mse"

    def __init__(self, at_step=None, does=None):
        rng = np.random.default_rng(0)
        self.targets = np.linspace(-1, 1, self.size, dtype=np.float32)
        noise = rng.normal(size=(self.size, 3, 8, 8)).astype(np.float32)
        self.images = self.targets[:, None, None, None] + noise
        self.at_step, self.does = at_step, does
        self.steps = 0

    def batch(self, indices, rng):
        noise = rng.normal(scale=0.1, size=(len(indices), 3, 8, 8)).astype(np.float32)
        return self.images[indices] + noise, self.targets[indices]

    def loss(self, model, batch):
        self.steps += 1
        if self.steps == self.at_step:
            self.does()
        images, targets = batch
        squared = (model(images) - targets).square().mean()
        return squared, {"root": squared.sqrt()}

    def evaluate(self, model):
        error = model(torch.from_numpy(self.images)) - torch.from_numpy(self.targets)
        return {"mse": float(error.square().mean()), "mae": float(error.abs().mean())}


def run(folder, task=None, **changes):
    """Train a toy; ``resume`` and ``overwrite`` go to ``train``, other keywords change the options."""
    flags = {name: changes.pop(name) for name in ("resume", "overwrite") if name in changes}
    with seeded(1):
        model = Toy()
    return train(
        model,
        task or ToyTask(),
        replace(OPTIONS, **changes),
        Path(folder),
        CARD,
        tensorboard=False,
        quiet=True,
        **flags,
    )


if __name__ == "__main__":
    folder, step = sys.argv[1:]
    run(folder, ToyTask(int(step), lambda: os.kill(os.getpid(), signal.SIGKILL)))
