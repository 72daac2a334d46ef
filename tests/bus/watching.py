"""In the guest: soilbus watch --json on vcan0 while a log of our frames is played onto it; LOG OUT.

OUT has the lines that it printed until SIGINT.  It is listening once it has said that it hears nothing.
"""

from __future__ import annotations

import signal
import subprocess
import sys

log, out = sys.argv[1:]
command = [sys.executable, "-m", "soilbus", "watch", "--json", "--channel", "vcan0"]
with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as watch:
    assert watch.stdout is not None
    first = watch.stdout.readline()
    subprocess.run(["canplayer", "-I", log, "vcan0=can0"], check=True)
    watch.send_signal(signal.SIGINT)
    lines = [first, *watch.stdout]
    assert watch.wait(timeout=20.0) == -signal.SIGINT
with open(out, "w", encoding="utf-8") as file:
    file.writelines(lines)
