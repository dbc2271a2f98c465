"""``train``: claim a folder, run, and say what came of it."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import nn

from nl_env.training.checkpoint import Progress
from nl_env.training.log import EVENTS_FOLDER, LOG_FILE, Log
from nl_env.training.options import TrainingOptions, resolve_device, seeded
from nl_env.training.run import BEST, LAST, Run
from nl_env.training.task import Task
from nl_env.weight_files import Card, card_path, read_card


@dataclass(frozen=True)
class TrainingResult:
    """How a training ended."""

    weights: Path
    """The best weights; their card lies beside them."""
    card: Card
    progress: Progress
    """Steps done (fewer than asked for where patience ended it), the best one, time."""


def train(
    model: nn.Module,
    task: Task,
    options: TrainingOptions,
    folder: Path,
    card: Card,
    *,
    resume: bool = False,
    overwrite: bool = False,
    tensorboard: bool = True,
    quiet: bool = False,
) -> TrainingResult:
    """Train ``model`` in place and leave its checkpoints, best weights, card and log in ``folder``.

    Args:
        model: freshly initialised (see ``seeded``); a resumed run overwrites its weights.
        task: data, loss and validation.
        options: how.
        folder: of this run; created.
        card: what the weights are; ``training`` and ``metrics`` are filled in here.
        resume: go on from the last checkpoint, from the start where there is none.
        overwrite: discard the run that is there.
        tensorboard: write events for TensorBoard, where it is installed.
        quiet: print nothing.

    Raises:
        FileExistsError: the folder holds a run and neither flag was given.
        ValueError: both flags, no samples, a checkpoint of other settings, or no finite criterion.
        FloatingPointError: loss or gradient is not finite; the last checkpoint is kept.
        OSError: a checkpoint cannot be written; the previous one is kept.
    """
    if task.size < 1:
        raise ValueError(f"task: found {task.size} training samples, expected at least 1")
    _claim(folder, resume, overwrite)
    device = resolve_device(options.device)
    with _threads(options.threads), seeded(options.seed), torch.backends.cudnn.flags(deterministic=True):
        run = Run(model, task, options, folder, card, device)
        if resume and (folder / LAST).exists():
            run.restore()
        log = Log(folder, run.progress.step, run.total, tensorboard, quiet)
        try:
            run.go(log)
        finally:
            log.close()
    best = folder / BEST
    written = read_card(best)
    assert written is not None
    return TrainingResult(best, written, run.progress)


def _claim(folder: Path, resume: bool, overwrite: bool) -> None:
    """Make ``folder`` ready for a run: nothing of another one in it, unless that goes on."""
    if resume and overwrite:
        raise ValueError("resume and overwrite: found both, expected at most one")
    folder.mkdir(parents=True, exist_ok=True)
    own = [folder / LAST, folder / BEST, card_path(folder / BEST), folder / LOG_FILE]
    if not (resume or overwrite) and any(path.exists() for path in own):
        raise FileExistsError(
            f"training: {folder} already holds a run; choose another folder, overwrite it, or resume"
        )
    half_written = [*folder.glob(".*.safetensors"), *folder.glob(".*.json")]
    for path in half_written if resume else [*own, *half_written]:
        path.unlink(missing_ok=True)
    if overwrite:
        shutil.rmtree(folder / EVENTS_FOLDER, ignore_errors=True)


@contextmanager
def _threads(count: int) -> Iterator[None]:
    """PyTorch's threads, set back afterwards; 0 leaves them."""
    before = torch.get_num_threads()
    torch.set_num_threads(count or before)
    try:
        yield
    finally:
        torch.set_num_threads(before)
