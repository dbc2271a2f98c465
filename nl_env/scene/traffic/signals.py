"""Right of way: stop lines, and what closes and opens them.

highway-env's vehicles know leaders but neither red lights nor priority at a roundabout; drivers brake for a
closed :class:`StopLine` as for a standing vehicle.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

LaneIndex = tuple[str, str, int]

COMFORTABLE_BRAKING = 2.0
"""Deceleration that a light leaves the ego room for, m/s^2."""


@dataclass(eq=False)
class StopLine:
    """A line across one lane, ``position`` metres along it, that nobody crosses while it is closed."""

    lane: LaneIndex
    position: float
    closed: bool = False


class Approaching(Protocol):
    """What signals know about a vehicle."""

    speed: float

    def distance_to(self, line: StopLine) -> float:
        """Metres along its route from its front to ``line``; ``inf`` if it is not ahead."""
        ...


class Signal(Protocol):
    """Decides which of its ``lines`` are closed."""

    lines: list[StopLine]

    def update(self, time: float, ego: Approaching, vehicles: Sequence[Approaching]) -> None:
        """Set ``closed`` of every line for simulation time ``time`` (s)."""
        ...


class TrafficLight:
    """Green for the ego until it comes near, then red for ``red`` seconds while the other phases take turns.

    Being triggered by the ego, it stops the ego at any speed and in any queue, and always comfortably.

    Args:
        phases: groups of lines that are open together. The first phase is the ego's and its first line the
            one the ego meets; a pedestrian crossing has no other phase.
        red: s; 0 never stops the ego.
    """

    CLEARANCE = 2.0
    """Seconds for which every line is closed between two phases."""

    def __init__(self, phases: Sequence[Sequence[StopLine]], red: float) -> None:
        self.phases = phases
        self.red = red
        self.lines = [line for phase in phases for line in phase]
        self._triggered_at = math.inf

    def update(self, time: float, ego: Approaching, vehicles: Sequence[Approaching]) -> None:
        braking_distance = ego.speed**2 / (2 * COMFORTABLE_BRAKING) + 0.5 * ego.speed + 2.0
        if self._triggered_at == math.inf and ego.distance_to(self.phases[0][0]) < braking_distance:
            self._triggered_at = time
        open_phase = self._open_phase(time - self._triggered_at)
        for k, phase in enumerate(self.phases):
            for line in phase:
                line.closed = k != open_phase

    def _open_phase(self, elapsed: float) -> int | None:
        if elapsed < 0 or elapsed >= self.red:
            return 0
        others = len(self.phases) - 1
        if others == 0 or elapsed < self.CLEARANCE:
            return None
        turn, within = divmod(elapsed - self.CLEARANCE, (self.red - self.CLEARANCE) / others)
        green = (self.red - self.CLEARANCE) / others - self.CLEARANCE
        return 1 + int(turn) if within < green else None


class Yield:
    """Closed while somebody who has priority is about to pass ``conflict``."""

    TIME_GAP = 3.0
    """s; a roundabout is entered when nobody will pass within this time."""

    CLEAR_DISTANCE = 5.0

    def __init__(self, line: StopLine, conflict: StopLine) -> None:
        self.line = line
        self.conflict = conflict
        self.lines = [line]

    def update(self, time: float, ego: Approaching, vehicles: Sequence[Approaching]) -> None:
        self.line.closed = any(
            vehicle.distance_to(self.conflict) < vehicle.speed * self.TIME_GAP + self.CLEAR_DISTANCE
            for vehicle in vehicles
        )


class DeadEnd:
    """Always closed: the end of a lane that leads nowhere, such as a merging lane."""

    def __init__(self, line: StopLine) -> None:
        self.lines = [line]
        line.closed = True

    def update(self, time: float, ego: Approaching, vehicles: Sequence[Approaching]) -> None:
        """Nothing ever changes."""
