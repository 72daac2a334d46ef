"""Messages to systemd: ready, state in the STATUS line, alive, stopping (sd_notify(3))."""

from __future__ import annotations

import logging
import os
import socket
from collections.abc import Mapping
from dataclasses import dataclass, field

log = logging.getLogger(__name__)


@dataclass
class Notifier:
    """Sender to systemd's notification socket; without one every call does nothing.

    `watchdog` should be called every `watchdog_interval` [s], half of systemd's own limit; None where none is set.
    """

    address: str | None = None
    watchdog_interval: float | None = None
    _fails: bool = field(default=False, init=False, repr=False)

    @classmethod
    def from_environment(cls, environ: Mapping[str, str] = os.environ) -> Notifier:
        """Return the notifier that NOTIFY_SOCKET, WATCHDOG_USEC and WATCHDOG_PID ask for."""
        return cls(environ.get("NOTIFY_SOCKET") or None, _watchdog_interval(environ))

    def ready(self, status: str) -> None:
        """Tell systemd that the start-up is over; `status` as in `status`."""
        self._send("READY=1", _status(status))

    def status(self, text: str) -> None:
        """Tell state and reason for `systemctl status`, in one line."""
        self._send(_status(text))

    def watchdog(self) -> None:
        """Tell systemd that the loop has made a round; never call this from a thread that does no work."""
        if self.watchdog_interval is not None:
            self._send("WATCHDOG=1")

    def stopping(self) -> None:
        """Tell systemd that the service shuts down."""
        self._send("STOPPING=1")

    def _send(self, *fields: str) -> None:
        if self.address is None:
            return
        address = "\0" + self.address[1:] if self.address.startswith("@") else self.address
        try:
            with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as s:
                s.setblocking(False)  # a stuck systemd must not stop the loop
                s.sendto("\n".join(fields).encode(), address)
        except OSError as error:
            if not self._fails:
                log.warning("systemd not notified of %s: %s", fields[0], error.strerror or error)
            self._fails = True
            return
        self._fails = False


def _status(text: str) -> str:
    return "STATUS=" + " ".join(text.split())


def _watchdog_interval(environ: Mapping[str, str]) -> float | None:
    if environ.get("WATCHDOG_PID", str(os.getpid())) != str(os.getpid()):
        return None  # another process of ours is watched
    text = environ.get("WATCHDOG_USEC")
    if text is None:
        return None
    if not text.isascii() or not text.isdigit() or int(text) == 0:
        log.warning("WATCHDOG_USEC is not a number of microseconds: %r", text)
        return None
    return int(text) / 2e6


__all__ = ["Notifier"]
