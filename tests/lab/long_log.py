"""Memory that a batch takes for one long log: it does not grow with the log.

    python -m tests.lab.long_log [--gigabytes 1] [--hop 1] [--stretch 600]

A simulated log (of ten minutes) is written again and again, each time later, until the file is as large as asked for.
One worker replays it as `soilbus batch` does.  The resident memory of the worker and of the process that asks is
printed at each tenth of the log and at the end, with the peaks.
"""

from __future__ import annotations

import argparse
import os
import sys
import threading
import time
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

from soilbus.can.log_writer import write_log
from soilbus.offline.batch import cluster, run_batch
from soilbus.offline.parts import Job, setup_of
from soilbus.simulator.frames import frames
from soilbus.simulator.play import scenario_over
from soilbus.simulator.recording import simulate
from soilbus.simulator.reference import reference_configuration


def long_log(path: Path, size: float, seconds: float) -> float:
    """Write a candump log of `size` bytes, a drive of `seconds` again and again; its duration [s]."""
    config = reference_configuration()
    stretch = path.with_suffix(".stretch.log")
    write_log(frames(simulate(config, scenario_over(["loam"], seconds), seed=1), config), stretch)
    lines = [(float(stamp[1:]), rest) for stamp, rest in (line.split(b")", 1) for line in stretch.open("rb"))]
    begin, end = lines[0][0], lines[-1][0]
    later, written = 0.0, 0
    with path.open("wb") as out:
        while written < size:
            written += out.write(b"".join(b"(%.6f)%s" % (t + later, rest) for t, rest in lines))
            later += end - begin + 0.01
    return later


def resident(process: int, field: str = "VmRSS") -> float:
    """Resident memory of a process [MB]; "VmHWM": its peak."""
    text = Path(f"/proc/{process}/status").read_text()
    return next(int(line.split()[1]) * 1024e-6 for line in text.splitlines() if line.startswith(field))


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure and print; 1 where windows are missing."""
    parser = argparse.ArgumentParser(prog="python -m tests.lab.long_log", description=__doc__)
    parser.add_argument("--gigabytes", type=float, default=1.0, help="size of the log (1)")
    parser.add_argument("--hop", type=float, default=1.0, help="seconds between windows (1)")
    parser.add_argument("--stretch", type=float, default=600.0, help="seconds that are simulated (600)")
    chosen = parser.parse_args(arguments)
    config = reference_configuration([f"estimator.hop={chosen.hop}"])
    with TemporaryDirectory() as folder, cluster(None, print, processes=1) as client:
        log = Path(folder, "long.log")
        duration = long_log(log, chosen.gigabytes * 1e9, chosen.stretch)
        print(f"a log of {log.stat().st_size / 1e6:.0f} MB, {duration / 3600.0:.2f} h", flush=True)
        (worker,) = client.run(os.getpid).values()
        ended = threading.Event()
        seen: list[tuple[float, float, float]] = []
        begin = time.perf_counter()

        def look() -> None:
            while not ended.wait(1.0):
                seen.append((time.perf_counter() - begin, resident(worker), resident(os.getpid())))

        looking = threading.Thread(target=look, daemon=True)
        looking.start()
        batch = run_batch(client, [Job(str(log), "tractor", setup_of(config, "tractor.toml"))], Path(folder, "out"))
        ended.set()
        looking.join()
        for tenth in range(11):
            t, there, here = seen[min(len(seen) - 1, tenth * len(seen) // 10)]
            print(f"after {t:6.0f} s: worker {there:4.0f} MB, this process {here:4.0f} MB")
        print(f"peak: worker {resident(worker, 'VmHWM'):.0f} MB, this process {resident(os.getpid(), 'VmHWM'):.0f} MB")
        print(f"{batch.windows} windows of {batch.duration / 3600.0:.2f} h, {batch.cpu_seconds:.0f} CPU s")
        for error in batch.errors:
            print(error["fault"])
    return int(bool(batch.errors) or batch.windows < 0.9 * duration / chosen.hop)


if __name__ == "__main__":
    sys.exit(main())
