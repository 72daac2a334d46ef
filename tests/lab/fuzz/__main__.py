"""`python -m tests.lab.fuzz`."""

from __future__ import annotations

import sys

from tests.lab.fuzz.command import main

if __name__ == "__main__":
    sys.exit(main())
