"""Estimates soil parameters of tractors from their CAN bus."""

import os

__all__ = ["__version__"]

__version__ = "0.1.0"
"""Version of this package: the one place where it stands, which the build, `soilbus --version` and the bus read."""

# Our matrices are too small to be shared out among threads: waiting for each other they would take 1.7 times the
# processor time, and more wall time.  Numpy reads this when it is loaded, here or in a process that we start.
os.environ.setdefault("OMP_NUM_THREADS", "1")
