"""Kills a process that stores its state, again and again: killed.py FILE KILLS SEED; prints what was found as JSON."""

from __future__ import annotations

import json
import os
import random
import signal
import sys
import time
from pathlib import Path

import numpy as np

from soilbus.daemon.state_store import Owner, State, StateError, dumped, read, write_whole

OWNER = Owner("key", (), np.ones(6), np.ones(6))


def store_forever(path: Path, number: int, told: int) -> None:
    """Stores states of growing number and all sizes, and tells each that has been stored."""
    while True:
        number += 1
        totals = {f"{number}.{i}": i for i in range(number % 900)}
        write_whole(path, dumped(State(at=0.0, starts=number, gaussian=None, totals=totals), OWNER))
        os.write(told, number.to_bytes(8, "big"))


def main(path: Path, kills: int, seed: int) -> dict[str, int]:
    moments = random.Random(seed)
    found = {"kills": 0, "broken": 0, "lost": 0, "written": 0}
    number = 0
    for _ in range(kills):
        told, tell = os.pipe()
        child = os.fork()
        if child == 0:
            os.close(told)
            store_forever(path, number, tell)
        os.close(tell)
        os.read(told, 8)  # it stores
        time.sleep(moments.uniform(0.0, 0.02))
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
        known = number + 1
        while told_last := os.read(told, 8):
            known = int.from_bytes(told_last, "big")
        os.close(told)
        found["kills"] += 1
        try:
            state = read(path, OWNER)
        except StateError:
            found["broken"] += 1
            continue
        stored = 0 if state is None else state.starts
        found["lost"] += stored < known
        found["written"] += stored - number
        number = stored
    return found


if __name__ == "__main__":
    print(json.dumps(main(Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3]))))
