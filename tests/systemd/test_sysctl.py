"""The kernel may give as much receive buffer as the service asks for."""

from __future__ import annotations

import re
from pathlib import Path

from soilbus.can.bus import RECEIVE_BUFFER

SYSTEMD = Path(__file__).resolve().parents[2] / "systemd"


def test_the_limit_is_what_the_service_asks_for():
    settings = re.findall(r"^([\w.]+) = (\d+)$", (SYSTEMD / "soilbus.sysctl").read_text(), re.MULTILINE)
    assert settings == [("net.core.rmem_max", str(RECEIVE_BUFFER))]


def test_the_page_says_how_it_is_installed():
    page = (SYSTEMD / "README.md").read_text()
    assert '"$S"/soilbus.sysctl /etc/sysctl.d/80-soilbus.conf' in page
