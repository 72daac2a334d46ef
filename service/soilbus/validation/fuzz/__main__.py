"""`python -m soilbus.validation.fuzz`."""

from __future__ import annotations

import sys

from soilbus.validation.fuzz.command import main

if __name__ == "__main__":
    sys.exit(main())
