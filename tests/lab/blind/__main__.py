"""`python -m tests.lab.blind`."""

from __future__ import annotations

import sys

from soilbus.allocator import keep_freed_memory
from tests.lab.blind.command import main

if __name__ == "__main__":
    keep_freed_memory()
    sys.exit(main())
