"""Runs that measure the product; each is a command, `python -m tests.lab.NAME`."""

import sys
from pathlib import Path

sys.path.append(str(Path(__file__).parents[1] / "support"))  # as pytest does for tests
