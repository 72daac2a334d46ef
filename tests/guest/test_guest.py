"""The harness itself: what the vcan and systemd tests rely on."""

from pathlib import Path

import pytest

import guest
from availability import unavailable


@pytest.mark.vcan
def test_a_guest_that_hangs_ends_at_its_time_limit(tmp_path: Path) -> None:
    try:
        done = guest.run(["sh", "-c", f"echo before; echo lost > {tmp_path}/lost; sleep 1000"], timeout=5.0)
    except guest.Unavailable as reason:
        unavailable(str(reason))
        raise
    assert done.returncode == guest.NO_STATUS
    assert "before\n" in done.stdout
    assert "took more than 5 s" in done.stdout
    assert not (tmp_path / "lost").exists()  # written to the throw-away layer
