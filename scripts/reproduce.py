"""Measure the paper's tables again, on recorded sequences or on ELiDAR, ours beside the published figures.

Every finished sequence is kept in the output folder, so an interrupted run continues with --resume.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))  # agents/ is used from the checkout, wherever the command is started

import tyro

from nl_env.command_line import command_line, run_command
from scripts.tables.end_to_end import TableEndToEnd
from scripts.tables.gaps import TableAblation, TableRates
from scripts.tables.keyframe import TableKeyframe, TableWeather

Table = TableKeyframe | TableWeather | TableRates | TableAblation | TableEndToEnd


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; returns the exit status."""

    def work(given: list[str]) -> None:
        tyro.cli(Table, args=given, description=__doc__).run(command_line("reproduce", given))

    return run_command("reproduce", work, arguments, kept="finished sequences are kept")


if __name__ == "__main__":
    sys.exit(main())
