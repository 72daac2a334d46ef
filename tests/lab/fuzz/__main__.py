"""`python -m tests.lab.fuzz --target NAME --seconds N --seed S`.

Coverage-guided by atheris (extra `fuzz`) where it is installed; with --plain by seeded mutations
alone.  Either way a crash, an input that takes longer than LONGEST, or memory beyond LARGEST ends
the run with exit code 1 and the input in a file named by its digest.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import resource
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from tests.lab.fuzz.mutation import mutated

if TYPE_CHECKING:
    from tests.lab.fuzz.targets import Target

LONGEST = 30
"""Seconds for one input."""
LARGEST = 2048
"""Megabytes of address space beyond what the start takes."""
ROUND = 150
"""Seconds of processor time of one guided process: atheris keeps 24 kB to 1 MB of every input, ours keep none."""
PACKAGES = ["soilbus", "cantools"]


def main(arguments: Sequence[str] | None = None) -> int:
    """Parse, fuzz, report."""
    parser = argparse.ArgumentParser(prog="python -m tests.lab.fuzz", description=__doc__)
    parser.add_argument(
        "--target", required=True, help="frames, windows, service, dbc, config, model, state, logs, log-..."
    )
    parser.add_argument("--seconds", type=int, default=60, help="of processor time (60)")
    parser.add_argument("--seed", type=int, default=1, help="of the random numbers (1)")
    parser.add_argument("--plain", action="store_true", help="seeded mutations, not guided by coverage")
    parser.add_argument("--corpus", type=Path, help="folder of inputs that a guided run goes on from (a new one)")
    chosen = parser.parse_args(arguments)
    guided = not chosen.plain and find_spec("atheris") is not None
    if guided and chosen.seconds > ROUND:
        return _in_rounds(chosen.target, chosen.seconds, chosen.seed, chosen.corpus)
    targets = _instrumented() if guided else _targets()
    if chosen.target not in targets:
        parser.error(f"no target is named {chosen.target}; known: {', '.join(targets)}")
    target = targets[chosen.target]
    if guided:
        return _guided(chosen.target, target, chosen.seconds, chosen.seed, chosen.corpus)
    return _plain(chosen.target, target, chosen.seconds, chosen.seed)


def _in_rounds(name: str, seconds: int, seed: int, corpus: Path | None) -> int:
    """One process after the other, each with another seed and with what those before it found."""
    folder = corpus or Path(tempfile.mkdtemp(prefix=f"soilbus-fuzz-{name}-"))
    for i, begin in enumerate(range(0, seconds, ROUND)):
        of_round = ["--seconds", str(min(ROUND, seconds - begin)), "--seed", str(seed + i), "--corpus", str(folder)]
        code = subprocess.run([sys.executable, "-m", "tests.lab.fuzz", "--target", name, *of_round]).returncode
        print(f"{name}: round {i + 1} ended with {code}", flush=True)
        if code:
            return code
    return 0


def _instrumented() -> dict[str, Target]:
    """The targets with everything that they import watched for coverage."""
    import atheris

    with atheris.instrument_imports(include=PACKAGES):
        return _targets()


def _targets() -> dict[str, Target]:
    """Imported here, so that atheris can watch what they import."""
    from tests.lab.fuzz.targets import TARGETS

    return TARGETS


def _guided(name: str, target: Target, seconds: int, seed: int, corpus: Path | None) -> int:
    """libFuzzer's loop, which ends the process itself and leaves its corpus in a temporary folder.

    Its own limit of time counts what other processes take too.
    """
    import atheris

    folder = corpus or Path(tempfile.mkdtemp(prefix=f"soilbus-fuzz-{name}-"))
    folder.mkdir(exist_ok=True)
    for i, data in enumerate(target.seeds()):
        (folder / f"seed{i}").write_bytes(data[: target.longest])
    flags = [
        f"-seed={seed}", f"-timeout={LONGEST}", f"-rss_limit_mb={LARGEST}",
        f"-max_len={target.longest}", "-print_final_stats=1", f"-artifact_prefix={name}-",
    ]  # fmt: skip
    end = time.process_time() + seconds

    def one(data: bytes) -> None:
        if time.process_time() >= end:
            os.kill(os.getpid(), signal.SIGUSR1)  # libFuzzer's end with figures
        target.one(data)

    atheris.Setup([sys.argv[0], *flags, str(folder)], one)
    atheris.Fuzz()
    return 0


def _plain(name: str, target: Target, seconds: float, seed: int) -> int:
    seeds, rng = target.seeds(), np.random.default_rng(seed)
    for data in seeds:
        target.one(data)
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + (LARGEST << 20),) * 2)
    signal.signal(signal.SIGALRM, _too_long)
    begin, inputs, total = time.process_time(), 0, 0
    while time.process_time() - begin < seconds:
        data = mutated(seeds, rng)
        signal.alarm(LONGEST)
        try:
            total += target.one(data)
        except BaseException as error:
            kept = Path(f"{name}-{hashlib.sha1(data).hexdigest()[:12]}")
            kept.write_bytes(data)
            if isinstance(error, KeyboardInterrupt):
                raise
            print(f"{name}: {type(error).__name__}: {error} on an input kept in {kept}", file=sys.stderr)
            raise
        finally:
            signal.alarm(0)
        inputs += 1
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    spent = time.process_time()
    print(f"{name}: {inputs} inputs, {total} frames, {spent:.0f} s processor time, peak {peak:.0f} MB: nothing found")
    return 0


def _too_long(signum: int, frame: object) -> None:
    raise TimeoutError(f"longer than {LONGEST} s")


if __name__ == "__main__":
    raise SystemExit(main())
