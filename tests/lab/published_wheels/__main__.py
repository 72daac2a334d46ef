"""`python -m tests.lab.published_wheels`."""

from __future__ import annotations

import sys

from tests.lab.published_wheels.comparison import main

if __name__ == "__main__":
    sys.exit(main())
