"""The kernel may give as much receive buffer as the service asks for."""

from __future__ import annotations

import re
from pathlib import Path
from types import SimpleNamespace

from soilbus.can.bus import ask_for_buffer

SYSTEMD = Path(__file__).resolve().parents[2] / "systemd"


def test_the_limit_is_what_the_service_asks_for():
    settings = re.findall(r"^([\w.]+) = (\d+)$", (SYSTEMD / "soilbus.sysctl").read_text(), re.MULTILINE)
    asked = []
    ask_for_buffer(SimpleNamespace(setsockopt=lambda level, option, size: asked.append(size)))
    assert asked
    assert settings == [("net.core.rmem_max", str(size)) for size in set(asked)]


def test_the_page_says_how_it_is_installed():
    page = (SYSTEMD / "README.md").read_text()
    assert '"$S"/soilbus.sysctl /etc/sysctl.d/80-soilbus.conf' in page
