"""What a test does when the machine lacks something."""

import os

import pytest


def unavailable(reason: str, variable: str = "SOILBUS_REQUIRE_GUEST") -> None:
    """Skip the test, or fail it where the environment variable is 1: then nothing may be skipped."""
    if os.environ.get(variable) == "1":
        pytest.fail(f"{reason} (and {variable}=1)", pytrace=False)
    pytest.skip(reason)
