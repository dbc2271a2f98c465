"""Markdown tables, and documents in which the results between a table's two marks are replaced."""

from __future__ import annotations

import math
import os
import platform
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, is_dataclass
from pathlib import Path
from typing import Any

from nl_env.runs import write_text

Rows = list[list[str]]
"""A header row, then one list of cells per row."""


@dataclass(frozen=True)
class Section:
    """One table of a result.

    Attributes:
        title: heading.
        rows: header first.
        text: one column of text this many columns wide at the left; the rest are numbers.
    """

    title: str
    rows: Rows
    text: int = 1


def markdown(sections: Sequence[Section], heading: str = "###") -> str:
    """All tables, each under its heading."""
    parts = []
    for section in sections:
        lines = ["| " + " | ".join(row) + " |" for row in section.rows]
        rule = "|---" * section.text + "|--:" * (len(section.rows[0]) - section.text) + "|"
        parts.append(f"{heading} {section.title}\n\n" + "\n".join([lines[0], rule, *lines[1:]]))
    return "\n\n".join(parts)


def marks(table: str) -> tuple[str, str]:
    """The lines between which the results of ``table`` stand."""
    return f"<!-- begin {table} -->", f"<!-- end {table} -->"


def check_document(document: Path, table: str) -> tuple[str, str]:
    """What is before and after the results of ``table`` in ``document``.

    Raises:
        FileNotFoundError: no such document.
        ValueError: its marks are missing, doubled or in the wrong order.
    """
    text = document.read_text(encoding="utf-8")
    begin, end = marks(table)
    if text.count(begin) != 1 or text.count(end) != 1 or text.index(begin) > text.index(end):
        raise ValueError(f"markdown: found no {begin} ... {end} in {document}, expected each once")
    return text[: text.index(begin)], text[text.index(end) + len(end) :]


def update_document(document: Path, table: str, text: str) -> None:
    """Replace the results of ``table`` in ``document``; errors as :func:`check_document`."""
    head, tail = check_document(document, table)
    begin, end = marks(table)
    write_text(document, f"{head}{begin}\n\n{text.strip()}\n\n{end}{tail}")


def machine() -> str:
    """The machine in words: processor and cores."""
    name = platform.processor() or platform.machine()
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.is_file():
        for line in cpuinfo.read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                name = line.split(":", 1)[1].strip()
                break
    return f"{name}, {os.cpu_count()} cores"


def jsonable(value: Any) -> Any:
    """Plain JSON: dataclasses are objects, what could not be measured is null."""
    if is_dataclass(value) and not isinstance(value, type):
        return jsonable(asdict(value))
    if isinstance(value, Mapping):
        return {str(key): jsonable(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [jsonable(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def cell(value: float, digits: int) -> str:
    """A number with ``digits`` significant digits, without a negative zero; ``-`` for nan."""
    return f"{value + 0.0:.{digits}g}" if math.isfinite(value) else "-"


def percent(value: float) -> str:
    """A relative change, signed; ``-`` when there is none to give."""
    if not math.isfinite(value):
        return "-"
    rounded = round(100 * value)
    return f"{rounded:+d} %" if rounded else "0 %"
