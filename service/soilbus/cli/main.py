"""The command line: parse, call one function of a room, print.

Exit codes: 0 done; 1 the work could not be done; 2 wrong usage or configuration; 130 interrupted.
"""

from __future__ import annotations

import logging
import sys
from collections.abc import Sequence
from importlib import import_module

from soilbus.allocator import loading
from soilbus.cli.arguments import command_line
from soilbus.process import output_fault, say
from soilbus.words import WorkError

DONE, FAILED, WRONG_USAGE, INTERRUPTED = 0, 1, 2, 130

COMMANDS = {
    "user": ("demo", "init", "run", "check", "watch", "completion", "docs"),
    "engineer": ("replay", "simulate", "diagnose", "batch"),
    "effects": ("effects",),
    "trials": ("paper", "decisions", "bench"),
}
"""Each file of commands, loaded when one of them is asked for; a command is the function of that name."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command and return its exit code."""
    args = command_line().parse_args(arguments)
    logging.basicConfig(level=logging.INFO, format="%(message)s", handlers=[_StandardError()])
    logging.getLogger("matplotlib").setLevel(logging.WARNING)  # what it does for itself is no news
    logging.getLogger("can").setLevel(logging.CRITICAL)  # we report a lost bus ourselves, once
    with loading():
        from soilbus.config.model import ConfigError
    try:
        with loading():
            file = next(file for file, commands in COMMANDS.items() if args.command in commands)
            module = import_module(f"soilbus.cli.{file}")
        getattr(module, args.command)(args)
        sys.stdout.flush()
    except ConfigError as error:
        for fault in error.faults:
            say(fault)
        return WRONG_USAGE
    except WorkError as error:
        say(str(error))
        return FAILED
    except KeyboardInterrupt:
        return INTERRUPTED
    except OSError as error:
        of_output = output_fault()
        if isinstance(of_output or error, BrokenPipeError):  # the reader of our output has seen enough
            return DONE
        where = "standard output: " if of_output else f"{error.filename}: " if error.filename else ""
        say(f"{where}{error.strerror or error}")
        return FAILED
    except MemoryError:
        say("not enough memory")
        return FAILED
    return DONE


class _StandardError(logging.Handler):
    """The journal or the terminal: standard error as it is at the time."""

    def emit(self, record: logging.LogRecord) -> None:
        """One line."""
        say(self.format(record))
