"""The program `soilbus`."""

import signal
from typing import NoReturn

signal.signal(signal.SIGINT, signal.SIG_DFL)  # while all else is loaded there is nothing to tidy up


def program() -> NoReturn:
    """Run the command line as a process."""
    from soilbus.process import hold_standard_streams, run_and_leave

    hold_standard_streams()
    from soilbus.cli.main import main

    run_and_leave(main)


if __name__ == "__main__":
    program()
