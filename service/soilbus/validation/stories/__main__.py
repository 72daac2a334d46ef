"""`python -m soilbus.validation.stories`."""

from __future__ import annotations

import sys

from soilbus.validation.stories.command import main

if __name__ == "__main__":
    sys.exit(main())
