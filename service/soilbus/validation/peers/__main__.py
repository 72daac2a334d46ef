"""`python -m soilbus.validation.peers`."""

from __future__ import annotations

import sys

from soilbus.validation.peers.command import main

if __name__ == "__main__":
    sys.exit(main())
