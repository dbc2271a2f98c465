"""What an inspection finds, and how much it reads."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nl_env import colours
from nl_env.elidar.layout import RANGE

SHOWN_PROBLEMS = 10
"""In the text; JSON has all."""
TILES = 8
"""Sequences, or event frames, of which a finding has pictures."""
MIN_DEPTH = 1.0
"""Nearest depth of the colour scale, m."""


@dataclass(frozen=True)
class Reading:
    """How much is read.

    Attributes:
        verify: everything, so that damage is found wherever it is.
        max_depth: range of ELiDAR's depth, m.
        pictures: also make pictures of depth and events.
    """

    verify: bool = False
    max_depth: float = RANGE
    pictures: bool = False


@dataclass
class Findings:
    """What one thing is.

    Attributes:
        kind: in words.
        path: where it is.
        facts: JSON-ready values by name.
        problems: what is wrong with it.
        pictures: RGB images of its content.
    """

    kind: str
    path: Path
    facts: dict[str, Any] = field(default_factory=dict)
    problems: list[str] = field(default_factory=list)
    pictures: list[colours.Image] = field(default_factory=list)

    def attempt(self, read: Callable[[], Any]) -> None:
        """Call ``read`` and keep what it raises as a problem."""
        try:
            read()
        except (ValueError, OSError) as error:
            self.problems.append(str(error))

    def add_picture(self, depth: NDArray[np.float32], events: NDArray[Any], max_depth: float) -> None:
        """Add ``(H, W)`` depth and the event sums of the same moment, side by side."""
        self.pictures.append(colours.depth(depth, MIN_DEPTH, max_depth))
        self.add_events(events)

    def add_events(self, events: NDArray[Any]) -> None:
        """Add ``(H, W)`` event sums."""
        self.pictures.append(colours.events(events.astype(np.int16)))

    def as_json(self) -> dict[str, Any]:
        """Everything but the pictures."""
        return {"kind": self.kind, "path": str(self.path), **self.facts, "problems": self.problems}

    def text(self) -> str:
        """A few lines."""
        facts = [f"  {name.replace('_', ' ')}: {_words(value)}" for name, value in self.facts.items()]
        shown = [f"  PROBLEM: {problem}" for problem in self.problems[:SHOWN_PROBLEMS]]
        if len(self.problems) > SHOWN_PROBLEMS:
            shown.append(f"  and {len(self.problems) - SHOWN_PROBLEMS} more problems")
        return "\n".join([f"{self.kind}: {self.path}", *facts, *shown])


def _words(value: Any) -> str:
    if isinstance(value, dict):
        return ", ".join(f"{name} {_words(item)}" for name, item in value.items()) or "none"
    return f"{value:.4g}" if isinstance(value, float) else str(value)
