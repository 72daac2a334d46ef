"""`python -m tests.lab.stories`."""

from __future__ import annotations

import sys

from tests.lab.stories.command import main

if __name__ == "__main__":
    sys.exit(main())
