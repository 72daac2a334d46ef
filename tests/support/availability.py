"""What a test does when the machine lacks something."""

from __future__ import annotations

import os

import pytest


def unavailable(reason: str) -> None:
    """Skip the test, or fail it where SOILBUS_REQUIRE_GUEST=1 says that nothing may be skipped."""
    if os.environ.get("SOILBUS_REQUIRE_GUEST") == "1":
        pytest.fail(f"{reason} (and SOILBUS_REQUIRE_GUEST=1)", pytrace=False)
    pytest.skip(reason)
