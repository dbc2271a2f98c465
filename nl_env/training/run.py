"""One training as it runs: its steps, validations and checkpoints."""

from __future__ import annotations

import copy
import math
import os
import platform
import time
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.optim.swa_utils import get_ema_multi_avg_fn

from nl_env.training import checkpoint
from nl_env.training.batches import Batches
from nl_env.training.checkpoint import Progress
from nl_env.training.log import Log
from nl_env.training.options import FREE_TO_CHANGE, TrainingOptions, make_optimiser, uses_bf16
from nl_env.training.task import Forward, Task
from nl_env.weight_files import Card, read_card, write_card, write_weights

LAST, BEST = "last.safetensors", "best.safetensors"
"""Files of a run: everything needed to go on, and the weights that validated best."""

_DROPOUT = 3
"""Stream of random numbers beside those of ``batches``."""


class Run:
    """The moving parts of one training."""

    def __init__(
        self,
        model: nn.Module,
        task: Task,
        options: TrainingOptions,
        folder: Path,
        card: Card,
        device: torch.device,
    ) -> None:
        self.model = model.to(device)
        if options.channels_last:
            for parameter in self.model.parameters():
                if parameter.dim() == 4:
                    parameter.data = parameter.data.to(memory_format=torch.channels_last)
        self.task, self.options, self.folder, self.card, self.device = task, options, folder, card, device
        self.total = options.total_steps(task.size)
        self.average = copy.deepcopy(self.model).requires_grad_(False) if options.ema else None
        self.optimiser = make_optimiser(options, self.model)
        self.forward: Forward = _InFloat32(self.model, device, uses_bf16(options.amp, device))
        self.progress = Progress()
        self.saved_step: int | None = None

    @property
    def settings(self) -> dict[str, Any]:
        """What a resumed run must share."""
        options = asdict(self.options)
        for name in FREE_TO_CHANGE:
            del options[name]
        card = self.card
        return {
            "options": options,
            "architecture": {"name": card.architecture, **card.options},
            "data": {"samples": self.task.size, **card.data},
        }

    def restore(self) -> None:
        """Continue from the last checkpoint."""
        self.progress = checkpoint.load(
            self.folder / LAST, self.settings, self.model, self.average, self.optimiser
        )
        self.saved_step = self.progress.step

    def save(self) -> None:
        """Write the last checkpoint."""
        checkpoint.save(
            self.folder / LAST, self.progress, self.settings, self.model, self.average, self.optimiser
        )
        self.saved_step = self.progress.step

    def go(self, log: Log) -> None:
        """Take all steps that are left."""
        options, progress = self.options, self.progress
        if progress.finished:
            return
        batches = Batches(self.task, options.batch_size, options.seed)
        source = batches.ahead(progress.step, self.total, options.loader_workers)
        meter = _Meter(options.batch_size)
        self.model.train()
        try:
            for step in range(progress.step, self.total):
                began = time.perf_counter()
                batch = self._to_device(next(source))
                waited = time.perf_counter() - began
                parts = self._step(step, batch)
                seconds = time.perf_counter() - began
                meter.add(parts, seconds, waited)
                progress.step = step + 1
                progress.seconds += seconds
                log.step(progress.step)
                done = progress.step == self.total
                if done or progress.step % options.log_every == 0:
                    log.scalars(progress.step, "train", meter.read())
                if done or (options.evaluate_every and progress.step % options.evaluate_every == 0):
                    began = time.perf_counter()
                    log.scalars(progress.step, "validation", self._validate())
                    progress.seconds += time.perf_counter() - began
                    done = done or 0 < options.patience <= progress.stale
                progress.finished = done
                if done:
                    self._finish_card()
                if done or progress.step % options.checkpoint_every == 0:
                    self.save()
                if done:
                    break
        finally:
            source.close()

    def _step(self, step: int, batch: tuple[Tensor, ...]) -> dict[str, Tensor]:
        """One update; returns detached numbers for the log."""
        options = self.options
        for group in self.optimiser.param_groups:
            group["lr"] = options.rate(step, self.total)
        stream = np.random.SeedSequence(options.seed, spawn_key=(_DROPOUT, step))
        torch.manual_seed(int(stream.generate_state(1, np.uint64)[0]))
        self.optimiser.zero_grad(set_to_none=True)
        loss, parts = self.task.loss(self.forward, batch)
        loss.backward()
        norm = nn.utils.clip_grad_norm_(self.model.parameters(), options.clip_gradient or math.inf)
        if not math.isfinite(loss.item()) or not math.isfinite(norm.item()):
            raise FloatingPointError(
                f"training: found loss {loss.item()} and gradient norm {norm.item()} at step {step + 1}, "
                f"expected finite numbers; {self._last_checkpoint()}"
            )
        self.optimiser.step()
        if self.average is not None:
            self._update_average(self.average, step)
        return {"loss": loss.detach(), **{name: part.detach() for name, part in parts.items()}, "norm": norm}

    def _update_average(self, average: nn.Module, step: int) -> None:
        """Move the average towards the model; faster at first, when the weights are still far off."""
        decay = min(self.options.ema, (1 + step) / (10 + step))
        mine, theirs = list(average.parameters()), [p.detach() for p in self.model.parameters()]
        get_ema_multi_avg_fn(decay)(mine, theirs, step)
        for kept, current in zip(average.buffers(), self.model.buffers(), strict=True):
            kept.copy_(current)

    def _validate(self) -> dict[str, float]:
        """Evaluate; keep the weights where they are the best so far."""
        judged = self.model if self.average is None else self.average
        judged.eval()
        with torch.no_grad():  # a module may keep tensors it made, which inference mode would spoil
            metrics = {name: float(value) for name, value in self.task.evaluate(judged).items()}
        self.model.train()
        value = metrics.get(self.task.criterion, math.nan)
        if not math.isfinite(value):
            raise ValueError(
                f"validation: found {self.task.criterion} {value} in {metrics}, expected a finite number"
            )
        progress = self.progress
        if progress.best is None or value < progress.best:
            progress.best, progress.best_step = value, progress.step
            progress.best_metrics, progress.stale = metrics, 0
            self._write_best(judged)
        else:
            progress.stale += 1
        return metrics

    def _write_best(self, model: nn.Module) -> None:
        card = replace(
            self.card,
            training={**self.card.training, **self._training_facts()},
            metrics={**self.card.metrics, "validation": self.progress.best_metrics},
        )
        write_weights(self.folder / BEST, model.state_dict(), card)

    def _finish_card(self) -> None:
        """Note what the whole training took, which was not known when the best weights were written."""
        card = read_card(self.folder / BEST)
        assert card is not None
        facts = {"steps_in_all": self.progress.step, "seconds": round(self.progress.seconds, 1)}
        write_card(self.folder / BEST, replace(card, training={**card.training, **facts}))

    def _training_facts(self) -> dict[str, Any]:
        return {
            "options": asdict(self.options),
            "samples": self.task.size,
            "steps": self.progress.best_step,
            "seconds": round(self.progress.seconds, 1),
            "device": self.device.type,
            "threads": torch.get_num_threads(),
            "bf16": uses_bf16(self.options.amp, self.device),
            "cores": os.cpu_count(),
            "torch": torch.__version__,
            "python": platform.python_version(),
        }

    def _last_checkpoint(self) -> str:
        if self.saved_step is None:
            return "there is no checkpoint yet"
        return f"{self.folder / LAST} holds step {self.saved_step}"

    def _to_device(self, batch: Sequence[Tensor]) -> tuple[Tensor, ...]:
        return tuple(
            tensor.to(
                self.device,
                memory_format=torch.channels_last
                if self.options.channels_last and tensor.dim() == 4 and tensor.is_floating_point()
                else torch.preserve_format,
            )
            for tensor in batch
        )


class _InFloat32:
    """The model in bf16 autocast or not; what it returns is in float32 either way."""

    def __init__(self, model: nn.Module, device: torch.device, bf16: bool) -> None:
        self._model, self._device, self._bf16 = model, device.type, bf16

    def __call__(self, *inputs: Any, **named: Any) -> Any:
        with torch.autocast(self._device, torch.bfloat16, enabled=self._bf16):
            outputs = self._model(*inputs, **named)
        return _in_float32(outputs)


def _in_float32(outputs: Any) -> Any:
    if isinstance(outputs, Tensor):
        return outputs.float() if outputs.is_floating_point() else outputs
    if isinstance(outputs, dict):
        return {name: _in_float32(value) for name, value in outputs.items()}
    if isinstance(outputs, tuple) and hasattr(outputs, "_fields"):
        return type(outputs)(*map(_in_float32, outputs))
    if isinstance(outputs, (tuple, list)):
        return type(outputs)(map(_in_float32, outputs))
    return outputs


class _Meter:
    """Means over the steps since it was last read."""

    def __init__(self, batch_size: int) -> None:
        self._batch_size = batch_size
        self._clear()

    def _clear(self) -> None:
        self._sums: dict[str, Tensor] = {}
        self._steps, self._seconds, self._waited = 0, 0.0, 0.0

    def add(self, parts: dict[str, Tensor], seconds: float, waited: float) -> None:
        """One step that took ``seconds``, of which it ``waited`` for its batch."""
        for name, value in parts.items():
            self._sums[name] = self._sums[name] + value if name in self._sums else value
        self._steps += 1
        self._seconds += seconds
        self._waited += waited

    def read(self) -> dict[str, float]:
        """Means, samples per second, and the share of time spent waiting; starts anew."""
        values = {name: float(total) / self._steps for name, total in self._sums.items()}
        values["samples_per_s"] = self._steps * self._batch_size / self._seconds
        values["waiting"] = self._waited / self._seconds
        self._clear()
        return values
