"""Absolute time of ELiDAR's depth frames, rebuilt from the CSV.

The release stores no time stamps. Every row says how many ticks lie between two depth frames, so the rows
of a sequence are the edges of a graph over its frames; walking it from frame 0 gives the tick of each.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from nl_env.config import choice
from nl_env.elidar.metadata import ON_ERROR, Metadata, Problem, SequencePairs

SHOWN_ROWS = 20
"""Rows named in a message."""

PREVIOUS, PREVIOUS_LOW, PREVIOUS_HIGH = 20, 10, 40
"""Ticks before a depth frame: where the LiDAR frame before it would be at 10 Hz, and the limits of what
stands for it."""


def frame_ticks(pairs: SequencePairs) -> NDArray[np.int64]:
    """Tick (5 ms) of every depth frame of a sequence; frame 0 is at tick 0.

    Duplicate rows are fine as long as they agree.

    Returns:
        ``(frames,)`` int64, strictly increasing, where ``frames`` is the largest frame id in the rows plus 1.

    Raises:
        ValueError: rows contradict each other, do not connect all frames, or make a later frame earlier; the
            message has the sequence and the lines of the offending rows.
    """
    frames = int(max(pairs.prior.max(), pairs.truth.max())) + 1
    most = len(pairs) + 1
    if frames > most:  # before anything of that size is allocated
        rows = np.flatnonzero(np.maximum(pairs.prior, pairs.truth) >= most)
        raise _refusal(
            pairs, f"found frame {frames - 1}, while {len(pairs)} rows can place {most} frames", rows
        )
    reached = _walk(pairs)
    if len(reached) < frames:
        lost = next(frame for frame in range(frames) if frame not in reached)
        rows = np.array([row for row, prior in enumerate(pairs.prior.tolist()) if prior not in reached], int)
        what = f"found {frames - len(reached)} frames (first {lost}) that no chain of rows joins to frame 0"
        raise _refusal(pairs, what, rows)
    ticks = np.array([reached[frame] for frame in range(frames)], np.int64)
    if (ticks[pairs.truth] - ticks[pairs.prior] != pairs.duration).any():
        raise _refusal(pairs, *_contradiction(pairs))
    backwards = np.flatnonzero(np.diff(ticks) <= 0)
    if backwards.size:
        frame = int(backwards[0])
        involved = (pairs.prior == frame + 1) | (pairs.truth == frame + 1)
        what = (
            f"found frame {frame + 1} at tick {ticks[frame + 1]}, not after frame {frame} at {ticks[frame]}"
        )
        raise _refusal(pairs, what, np.flatnonzero(involved))
    return ticks


def previous_frame(ticks: NDArray[np.int64], frame: int) -> int | None:
    """The depth frame that stands for the LiDAR frame before ``frame``.

    The release pairs a depth frame with no earlier one, but its time line has others: the one nearest to
    100 ms before, the later one of two, among those 50 to 200 ms before. Of the released pairs 94 % have
    one, 22 ms off on average. None at the start of a sequence and where there is no such frame.
    """
    first, end = np.searchsorted(ticks, ticks[frame] - np.array([PREVIOUS_HIGH, PREVIOUS_LOW - 1]))
    if first == end:
        return None
    off = np.abs(ticks[frame] - PREVIOUS - ticks[first:end])
    return int(end - 1 - np.argmin(off[::-1]))


def rebuild_timelines(
    metadata: Metadata, *, on_error: str = "raise"
) -> tuple[dict[str, NDArray[np.int64]], tuple[Problem, ...]]:
    """:func:`frame_ticks` of every sequence.

    Returns:
        Ticks by sequence name, and the sequences left out with ``on_error="skip"``, those of ``metadata``
        included.

    Raises:
        ValueError: as :func:`frame_ticks`, with ``on_error="raise"``.
    """
    choice("on_error", on_error, ON_ERROR)
    ticks = {}
    problems = list(metadata.problems)
    for pairs in metadata.sequences:
        try:
            ticks[pairs.name] = frame_ticks(pairs)
        except ValueError as error:
            if on_error == "raise":
                raise
            problems.append(Problem(pairs.name, str(error)))
    return ticks, tuple(problems)


def _walk(pairs: SequencePairs) -> dict[int, int]:
    """Tick of every frame that a breadth-first walk from frame 0 reaches."""
    neighbours: dict[int, list[tuple[int, int]]] = {}
    for prior, truth, duration in zip(
        pairs.prior.tolist(), pairs.truth.tolist(), pairs.duration.tolist(), strict=True
    ):
        neighbours.setdefault(prior, []).append((truth, duration))
        neighbours.setdefault(truth, []).append((prior, -duration))
    reached = {0: 0}
    queue = [0]
    for frame in queue:  # grows while it is walked
        for other, step in neighbours.get(frame, ()):
            if other not in reached:
                reached[other] = reached[frame] + step
                queue.append(other)
    return reached


def _contradiction(pairs: SequencePairs) -> tuple[str, list[int]]:
    """What to say about rows that contradict each other, and which to look at.

    Where dropping one row, or all rows equal to it, makes the rest agree, the fewest such rows are named;
    otherwise the rows that contradict those before them.
    """
    equal_rows: dict[tuple[int, int, int], list[int]] = {}
    for row, edge in enumerate(
        zip(pairs.prior.tolist(), pairs.truth.tolist(), pairs.duration.tolist(), strict=True)
    ):
        equal_rows.setdefault(edge, []).append(row)
    cures = [
        rows
        for edge, rows in equal_rows.items()
        if not _late_contradictions([other for other in equal_rows if other != edge])
    ]
    if cures:
        fewest = min(map(len, cures))
        suspects = sorted(row for rows in cures if len(rows) == fewest for row in rows)
        return (
            "found durations that contradict each other; without one of these rows the rest agree",
            suspects,
        )
    late = _late_contradictions(list(equal_rows))
    suspects = sorted(row for edge in late for row in equal_rows[edge])
    return "found durations that contradict those of earlier rows", suspects


def _late_contradictions(edges: list[tuple[int, int, int]]) -> list[tuple[int, int, int]]:
    """Edges ``(prior, truth, duration)`` that contradict those before them; the graph may be in pieces.

    Pieces are joined one by one; every frame knows its tick relative to the root of its piece.
    """
    root = {frame: frame for edge in edges for frame in edge[:2]}
    tick = dict.fromkeys(root, 0)
    members = {frame: [frame] for frame in root}
    late = []
    for edge in edges:
        prior, truth, duration = edge
        shift = tick[prior] + duration - tick[truth]
        kept, moved = root[prior], root[truth]
        if kept == moved:
            if shift:
                late.append(edge)
            continue
        if len(members[kept]) < len(members[moved]):
            kept, moved, shift = moved, kept, -shift
        for frame in members.pop(moved):
            root[frame] = kept
            tick[frame] += shift
            members[kept].append(frame)
    return late


def _refusal(pairs: SequencePairs, what: str, rows: Iterable[int]) -> ValueError:
    lines = [int(pairs.lines[row]) for row in rows]
    shown = ", ".join(map(str, lines[:SHOWN_ROWS])) + (", ..." if len(lines) > SHOWN_ROWS else "")
    where = f" (line{'s' if len(lines) > 1 else ''} {shown})" if lines else ""
    return ValueError(
        f"{pairs.source}: {pairs.name}: {what}{where}; expected rows that give every frame one time"
    )
