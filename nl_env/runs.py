"""Output folders and long runs: never overwrite unasked, checkpoint each sequence, resume, worker processes.

A run is ``task(seed) -> result`` over many seeds. Results depend on the seed alone, so neither the number
of workers nor an interruption changes them.
"""

from __future__ import annotations

import json
import multiprocessing
import os
import signal
import tempfile
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Protocol, TypeVar

SETTINGS_FILE = "settings.json"
"""Marks a folder as the output of a run and holds everything that determines its results."""

THREAD_VARIABLES = ("NUMBA_NUM_THREADS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


class Checkpoint(Protocol):
    """A result that can be written to one file."""

    def save(self, path: Path) -> None:
        """Write everything to ``path``."""
        ...


@dataclass(frozen=True)
class Entry:
    """A result of plain values: its file is JSON, and a manifest can list it as it is."""

    def save(self, path: Path) -> None:
        """Write as JSON."""
        path.write_text(json.dumps(asdict(self), indent=1) + "\n", encoding="utf-8")

    @classmethod
    def load(cls: type[EntryType], path: Path) -> EntryType:
        """Read what :meth:`save` wrote."""
        return cls(**json.loads(path.read_text(encoding="utf-8")))


Result = TypeVar("Result", bound=Checkpoint)
EntryType = TypeVar("EntryType", bound=Entry)


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yield a temporary name beside ``path``; flush it to disk and rename it onto ``path`` on success.

    Whoever reads ``path`` sees the old file or the whole new one, also after a crash in between.
    """
    handle, name = tempfile.mkstemp(dir=path.parent, prefix=".", suffix=path.suffix)
    os.close(handle)
    temporary = Path(name)
    try:
        yield temporary
        with open(temporary, "rb+") as file:
            os.fsync(file.fileno())
        temporary.chmod(0o644)
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def write_text(path: Path, text: str) -> None:
    """Write ``text`` to ``path`` as UTF-8 through :func:`replacing`."""
    with replacing(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def remove_temporaries(folder: Path) -> None:
    """Delete what killed processes left of unfinished writes through :func:`replacing` in ``folder``."""
    for temporary in folder.glob(".*"):
        temporary.unlink(missing_ok=True)


def open_folder(
    folder: Path, settings: dict[str, Any], *, overwrite: bool = False, resume: bool = False
) -> Path:
    """Claim ``folder`` for a run and return the folder of its checkpoints, ``folder/sequences``.

    Args:
        folder: where the run writes; created with its parents.
        settings: JSON-ready values that determine the results (not the number of workers).
        overwrite: discard the checkpoints of the run that is there.
        resume: continue the run that is there; its settings must be the same.

    Raises:
        FileExistsError: the folder holds something and neither flag was given.
        PermissionError: the folder cannot be created or written.
        ValueError: both flags, or ``resume`` with other settings than the ones found.
    """
    if overwrite and resume:
        raise ValueError("overwrite and resume: found both, expected at most one")
    text = json.dumps(settings, indent=2, sort_keys=True) + "\n"
    marker = folder / SETTINGS_FILE
    checkpoints = folder / "sequences"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise PermissionError(f"out: cannot write to {folder} ({error}); choose another folder") from error

    if resume and marker.exists():
        found = json.loads(marker.read_text(encoding="utf-8"))
        wanted = json.loads(text)
        changed = sorted(key for key in found.keys() | wanted.keys() if found.get(key) != wanted.get(key))
        if changed:
            differences = ", ".join(
                f"{key} is {found.get(key)!r}, asked {wanted.get(key)!r}" for key in changed
            )
            raise ValueError(f"resume: {folder} holds a run with other settings: {differences}")
        remove_temporaries(checkpoints)
    elif any(folder.iterdir()):
        if not overwrite:
            what = "another run" if marker.exists() else "files that are not a run's"
            raise FileExistsError(
                f"out: {folder} already holds {what}; choose another folder, overwrite it, or resume"
            )
        if checkpoints.is_dir():
            for stale in checkpoints.iterdir():
                stale.unlink()
    checkpoints.mkdir(exist_ok=True)
    write_text(marker, text)
    return checkpoints


def run_sequences(
    task: Callable[[int], Result],
    load: Callable[[Path], Result],
    seeds: Sequence[int],
    checkpoints: Path,
    *,
    workers: int = 0,
    suffix: str = ".npz",
    progress: Callable[[int], None] = lambda finished: None,
    broken: Callable[[int, ValueError], None] | None = None,
) -> list[Result]:
    """Run ``task`` on every seed that has no checkpoint yet and return all results in the order of ``seeds``.

    Every result goes through its file, so a resumed run cannot differ from an uninterrupted one.

    Args:
        task: picklable when ``workers`` > 0.
        load: reads what ``Result.save`` wrote.
        seeds: distinct sequence seeds.
        checkpoints: from :func:`open_folder`.
        workers: spawned processes of one thread each; 0 runs in this process.
        suffix: of the checkpoints, ``<seed><suffix>``.
        progress: called with the number of newly finished sequences.
        broken: called where ``task`` finds damaged data (a ``ValueError``); the seed has no result then, and
            is tried again when the run is resumed. None raises the error.

    Raises:
        ValueError: a negative number of workers, or what ``task`` raises.
    """
    if workers < 0:
        raise ValueError(f"workers: found {workers}, expected 0 or more")
    files = {seed: checkpoints / f"{seed}{suffix}" for seed in seeds}
    missing = [seed for seed in seeds if not files[seed].exists()]
    progress(len(files) - len(missing))
    finished = _in_processes(task, missing, workers) if workers else _in_this_process(task, missing)
    try:
        for seed, result in finished:
            if isinstance(result, ValueError):
                if broken is None:
                    raise result
                broken(seed, result)
                del files[seed]
            else:
                with replacing(files[seed]) as temporary:
                    result.save(temporary)
            progress(1)
    except BaseException:
        finished.close()  # ends the workers
        remove_temporaries(checkpoints)
        raise
    return [load(file) for file in files.values()]


def _in_this_process(
    task: Callable[[int], Result], seeds: Sequence[int]
) -> Generator[tuple[int, Result | ValueError], None, None]:
    for seed in seeds:
        try:
            result: Result | ValueError = task(seed)
        except ValueError as error:
            result = error
        yield seed, result


def _in_processes(
    task: Callable[[int], Result], seeds: Sequence[int], workers: int
) -> Generator[tuple[int, Result | ValueError], None, None]:
    """Yield ``(seed, task(seed))`` as spawned workers finish; an interrupt ends them at once."""
    with _one_thread_each():
        pool = ProcessPoolExecutor(
            max_workers=max(1, min(workers, len(seeds))),
            mp_context=multiprocessing.get_context("spawn"),
            initializer=_die_on_interrupt,
        )
        others = set(multiprocessing.active_children())
        try:
            futures = {pool.submit(task, seed): seed for seed in seeds}
            for future in as_completed(futures):
                error = future.exception()
                yield futures[future], error if isinstance(error, ValueError) else future.result()
        except BaseException:
            children = set(multiprocessing.active_children()) - others
            for child in children:
                child.terminate()
            for child in children:
                child.join()
            pool.shutdown(wait=False, cancel_futures=True)
            raise
        pool.shutdown()


def _die_on_interrupt() -> None:
    """Ctrl-C reaches every process of the terminal; the workers leave quietly, the parent reports."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


@contextmanager
def _one_thread_each() -> Iterator[None]:
    """Children inherit one thread per numeric library: threads inside parallel processes only compete."""
    before = {name: os.environ.get(name) for name in THREAD_VARIABLES}
    os.environ.update(dict.fromkeys(THREAD_VARIABLES, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value
