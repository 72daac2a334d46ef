"""`python -m soilbus.validation.soak`."""

from __future__ import annotations

import sys

from soilbus.validation.soak.command import main

if __name__ == "__main__":
    sys.exit(main())
