"""What belongs to a process around the command line: how signals end it, its standard streams, its last moment.

A signal lets the work tidy up and then ends the process as signals do (a shell sees it, a script stops), without
a traceback.  Standard streams may be closed, full, or of an encoding that lacks a character.  A thread that still
works when all is done, on a disk that does not answer say, is not waited for.
"""

from __future__ import annotations

import io
import os
import signal
import sys
import threading
import traceback
from collections.abc import Callable
from contextlib import suppress
from types import FrameType
from typing import NoReturn

from soilbus.words import shown

ENDING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


class Ended(KeyboardInterrupt):
    """Signal that ends the process."""


def run_and_leave(main: Callable[[], int]) -> NoReturn:
    """Leave the process with the exit code of `main`, or by the signal that ended it."""
    received: list[int] = []
    _hush_threads_of(received)

    def end(number: int, _: FrameType | None) -> None:
        signal.signal(number, signal.SIG_DFL)  # the next one ends it at once
        received.append(number)
        raise Ended

    for number in ENDING:
        if signal.getsignal(number) is not signal.SIG_IGN:  # nohup
            signal.signal(number, end)
    try:
        code = main()
    except SystemExit as error:  # of argparse
        code = error.code if isinstance(error.code, int) else 1
    except BaseException:  # a library may have made any exception of a signal's
        if not received:
            traceback.print_exc()
        code = 1
    if received:
        signal.signal(received[0], signal.SIG_DFL)
        os.kill(os.getpid(), received[0])
    fault = output_fault()
    if fault is not None and code == 0 and not isinstance(fault, BrokenPipeError):
        say(f"standard output: {fault.strerror}")
        code = 1
    _give_up_messages()
    if any(not thread.daemon for thread in threading.enumerate() if thread is not threading.main_thread()):
        os._exit(code)
    sys.exit(code)


def _hush_threads_of(received: list[int]) -> None:
    """What threads and destructors make of a signal is no news once there is one."""
    of_thread, unraisable = threading.excepthook, sys.unraisablehook
    threading.excepthook = lambda args: None if received else of_thread(args)
    sys.unraisablehook = lambda args: None if received else unraisable(args)


def _give_up_messages() -> None:
    """What standard error has not taken by now is lost, and no reason for another exit code."""
    try:
        sys.stderr.flush()
    except OSError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), 2)


def hold_standard_streams() -> None:
    """Keep later files from becoming standard streams, and let no character break what is written."""
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:  # then results cannot be written, and nobody waits for messages
            os.open(os.devnull, os.O_RDONLY if number == 1 else os.O_WRONLY)
    if sys.stdout is None:
        sys.stdout = io.TextIOWrapper(io.BufferedWriter(io.FileIO(1, "w", closefd=False)), "utf-8")
    if sys.stderr is None:
        sys.stderr = io.TextIOWrapper(io.BufferedWriter(io.FileIO(2, "w", closefd=False)), "utf-8")
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="replace")


def output_fault() -> OSError | None:
    """Return why standard output does not take what was written, and drop all output from then on; else None."""
    try:
        sys.stdout.flush()
        os.write(1, b"")  # what is larger than the buffer is lost at once and leaves nothing to flush
    except OSError as error:
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        return error
    return None


def say(text: str) -> None:
    """Print one line for the user, where somebody is still there to read it."""
    with suppress(OSError):
        print(f"soilbus: {shown(text)}", file=sys.stderr, flush=True)
