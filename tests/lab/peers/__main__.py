"""`python -m tests.lab.peers`."""

from __future__ import annotations

import sys

from tests.lab.peers.command import main

if __name__ == "__main__":
    sys.exit(main())
