"""How a command ends: bad input as one line, an interrupt with the command that goes on."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Callable, Sequence

BAD_INPUT, INTERRUPTED = 2, 130
"""Exit statuses."""

RESUME = "--resume"
_OF_ONE_RUN = (RESUME, "--overwrite")


def command_line(script: str, arguments: Sequence[str]) -> str:
    """The command that gives the same results: without ``--resume`` and ``--overwrite``.

    Args:
        script: name of the file in ``scripts/``, without its suffix.
        arguments: as given.
    """
    lasting = [argument for argument in arguments if argument not in _OF_ONE_RUN]
    return shlex.join(["python", f"scripts/{script}.py", *lasting])


def run_command(
    script: str,
    work: Callable[[list[str]], int | None],
    arguments: Sequence[str] | None = None,
    *,
    kept: str = "",
    again: str = RESUME,
    errors: tuple[type[Exception], ...] = (),
) -> int:
    """Run ``work(arguments)`` and return the command's exit status.

    ``ValueError`` and ``OSError`` are what bad input and a full disk raise: their message goes to standard
    error. Other exceptions are defects and pass.

    Args:
        script: name of the file in ``scripts/``, without its suffix.
        work: does everything; its result is the exit status, None means 0.
        arguments: of the command; None takes the process's.
        kept: what an interrupted run leaves to go on from, e.g. ``"finished sequences are kept"``.
        again: the option that goes on; empty if the same command does.
        errors: further exceptions that say what is wrong with the input.
    """
    given = list(sys.argv[1:] if arguments is None else arguments)
    bad_input: tuple[type[Exception], ...] = (ValueError, OSError, *errors)
    try:
        return work(given) or 0
    except bad_input as error:
        print(f"{script}: {error}", file=sys.stderr)
        refused = (FileNotFoundError, FileExistsError)  # before any work was done
        if kept and again and isinstance(error, OSError) and not isinstance(error, refused):
            print(f"{kept}; see {again}", file=sys.stderr)
        return BAD_INPUT
    except KeyboardInterrupt:
        ways_on = f"; {kept}. Continue with: {command_line(script, given)} {again}".rstrip() if kept else ""
        print(f"\ninterrupted{ways_on}", file=sys.stderr)
        return INTERRUPTED
