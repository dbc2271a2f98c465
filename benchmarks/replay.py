"""Environment steps per second when recordings are replayed, at 120x160. Prints JSON.

    python benchmarks/replay.py --markdown docs/data.md > docs/replay.json

Every row replays the same short recordings with a random policy, the environment made as users make it:
with the errors of ``repeat`` computed from the recording's depth, with stored traces, in a vector
environment of two processes, and batched in one process. Steps count environments, not vector steps;
every process has one thread. The best of several rounds is reported, as other work only ever slows one
down; processor time says what one process would reach on a machine with nothing else to do.
"""

from __future__ import annotations

import json
import os
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("NUMBA_NUM_THREADS", "1")
sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import gymnasium as gym
import numpy as np
import tyro

import nl_env  # noqa: F401 - registers the environments
from nl_env.config import SPLITS, DrivingConfig, SceneConfig
from nl_env.depth.extrapolators import make_extrapolator
from nl_env.observations import OBS_MODES
from nl_env.recording import record_sequence
from nl_env.recording_stream import RecordingStream
from nl_env.reproduction.document import check_document, update_document
from nl_env.trace_files import SUFFIX, write_trace
from nl_env.trace_source import TraceSource, file_digest, identify_extrapolator
from nl_env.traces import trace_sequence

EXTRAPOLATOR = "repeat"
PROCESSES = 2


@dataclass(frozen=True)
class Args:
    """What to measure and where to write it."""

    sequences: int = 2
    """Number of recordings."""
    duration: float = 5.0
    """Length of each, seconds."""
    num_envs: int = 64
    """Environments of the batched vector environment."""
    seconds: float = 2.0
    """Least time of a round."""
    rounds: int = 5
    """Rounds a row; the best counts."""
    markdown: Path | None = None
    """Document whose results are replaced."""


@dataclass(frozen=True)
class Row:
    """One measurement."""

    environment: str
    obs_mode: str
    processes: int
    num_envs: int
    steps_per_s: float
    steps_per_cpu_s: float | None
    """Of the processor time of this process; None where others work, too."""


@contextmanager
def recordings(args: Args) -> Iterator[tuple[Path, Path]]:
    """A folder of recordings and one of their traces, gone at the end."""
    config = DrivingConfig(scene=SceneConfig(duration_s=args.duration))
    identity = identify_extrapolator(EXTRAPOLATOR)
    with tempfile.TemporaryDirectory() as folder:
        data, tables = Path(folder, "data"), Path(folder, "tables")
        data.mkdir()
        tables.mkdir()
        for seed in SPLITS["test"][: args.sequences]:
            path = data / f"{seed}.h5"
            record_sequence(path, config, seed)
            trace = trace_sequence(RecordingStream([path]), make_extrapolator(EXTRAPOLATOR), seed)
            source = TraceSource.of(file_digest(path), identity, config.lidar)
            write_trace(tables / f"{seed}{SUFFIX}", trace, source)
        yield data, tables


def rates(step: Callable[[int], Any], steps: int, args: Args) -> tuple[float, float]:
    """Environment steps per second, and per second of processor time, of ``step(k)``, which makes ``steps``.

    Of the best round each.
    """
    best, best_cpu, k = 0.0, 0.0, 0
    for _ in range(args.rounds):
        calls, start, start_cpu = 0, time.perf_counter(), time.process_time()
        while (elapsed := time.perf_counter() - start) < args.seconds:
            step(k)
            k, calls = k + 1, calls + 1
        best = max(best, steps * calls / elapsed)
        best_cpu = max(best_cpu, steps * calls / (time.process_time() - start_cpu))
    return round(best, 1), round(best_cpu, 1)


def measure_single(args: Args, **arguments: Any) -> tuple[float, float]:
    """One environment, reset when a sequence ends."""
    env = gym.make("nl_env/Replay-v0", extrapolator=EXTRAPOLATOR, **arguments)
    actions = np.random.default_rng(0).integers(2, size=4096)
    env.reset(seed=0)

    def step(k: int) -> None:
        if env.step(actions[k % len(actions)])[3]:
            env.reset()

    found = rates(step, 1, args)
    env.close()
    return found


def measure_vector(args: Args, num_envs: int, mode: str, **arguments: Any) -> tuple[float, float]:
    """A vector environment, stepped all at once."""
    env = gym.make_vec(
        "nl_env/Replay-v0",
        num_envs=num_envs,
        vectorization_mode=mode,
        extrapolator=EXTRAPOLATOR,
        **arguments,
    )
    actions = np.random.default_rng(0).integers(2, size=(4096, num_envs))
    env.reset(seed=0)
    found = rates(lambda k: env.step(actions[k % len(actions)]), num_envs, args)
    env.close()
    return found


def measure(args: Args) -> list[Row]:
    """Every row."""
    rows = []
    with recordings(args) as (data, tables):
        stored = {"data": data, "errors": "table", "tables": tables}
        computed = measure_single(args, data=data)
        rows.append(Row("one, errors computed", "image", 1, 1, *computed))
        for mode in OBS_MODES:
            found = measure_single(args, **stored, obs_mode=mode)
            rows.append(Row("one, stored traces", mode, 1, 1, *found))
        for mode in ("image", "statistics"):
            found = measure_vector(args, PROCESSES, "async", **stored, obs_mode=mode)
            rows.append(Row("AsyncVectorEnv, stored traces", mode, PROCESSES, PROCESSES, found[0], None))
        for mode in OBS_MODES:
            found = measure_vector(args, args.num_envs, "vector_entry_point", **stored, obs_mode=mode)
            rows.append(Row("batched, stored traces", mode, 1, args.num_envs, *found))
    return rows


def table(rows: list[Row]) -> str:
    """The rows as Markdown."""
    lines = [
        "| environment | `obs_mode` | processes | environments | steps/s | steps per CPU second |",
        "|---|---|--:|--:|--:|--:|",
    ]
    for row in rows:
        cpu = "" if row.steps_per_cpu_s is None else f"{row.steps_per_cpu_s:,.0f}"
        cells = (
            row.environment,
            f"`{row.obs_mode}`",
            row.processes,
            row.num_envs,
            f"{row.steps_per_s:,.0f}",
            cpu,
        )
        lines.append(f"| {' | '.join(map(str, cells))} |")
    return "\n".join(lines)


def main(args: Args) -> None:
    """Measure, print JSON, and write the document."""
    if args.markdown is not None:
        check_document(args.markdown, "results")
    rows = measure(args)
    print(json.dumps({**asdict(args), "markdown": None, "rows": [asdict(row) for row in rows]}, indent=2))
    if args.markdown is not None:
        update_document(args.markdown, "results", table(rows))


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))
