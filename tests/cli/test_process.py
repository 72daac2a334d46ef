"""The program as a process: signals, standard streams, files that are left, workers that are left."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from soilbus.simulator.reference import TRACTOR

FIELD = Path(__file__).resolve().parents[1] / "field/field.toml"
PROGRAM = (sys.executable, "-m", "soilbus")
ENVIRONMENT = {name: value for name, value in os.environ.items() if not name.startswith(("PYTHON", "LC_", "LANG"))}
PATH = {"PYTHONPATH": os.environ.get("PYTHONPATH", "")}
LONGEST = 30.0
"""Seconds after which what was asked for will not come any more."""


def run(*words: str | bytes, shell: str = '"$@"', **environment: str) -> subprocess.CompletedProcess[bytes]:
    """The program, by way of a shell's redirections."""
    command = ["bash", "-c", shell, "bash", *PROGRAM, *words]
    return subprocess.run(command, capture_output=True, timeout=60.0, env=ENVIRONMENT | PATH | environment)


def one_line(done: subprocess.CompletedProcess[bytes]) -> str:
    (line,) = done.stderr.decode(errors="replace").splitlines()
    assert line.startswith("soilbus: ")
    return line


@pytest.fixture(scope="module")
def log(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("log") / "drive.log"
    assert run("simulate", "--duration", "11", "--seed", "5", "--log", str(path)).returncode == 0
    return path


def test_results_that_cannot_be_written_are_a_failure(log):
    assert "standard output" in one_line(closed := run("check", "--config", str(FIELD), shell='"$@" >&-'))
    assert "No space left" in one_line(help_ := run("--help", shell='"$@" >/dev/full'))
    words = ("replay", "--config", str(TRACTOR), str(log), "--json", "-")
    assert "No space left" in one_line(json := run(*words, shell='"$@" >/dev/full'))
    assert [done.returncode for done in (closed, help_, json)] == [1, 1, 1]


@pytest.mark.parametrize("to", ["2>&-", "2>/dev/full"])
def test_a_fault_that_nobody_can_read_keeps_its_exit_code(to):
    done = run("check", "--config", "nowhere.toml", shell=f'"$@" {to}')
    assert (done.returncode, done.stdout, done.stderr) == (2, b"", b"")


def test_what_has_nothing_to_say_needs_nobody_to_read_it():
    assert run("check", "--config", str(FIELD), shell='"$@" 2>&-').returncode == 0


def test_a_reader_that_has_seen_enough_is_no_failure(log):
    words = ("replay", "--config", str(TRACTOR), str(log), "--json", "-")
    done = run(*words, shell='"$@" | true; echo ${PIPESTATUS[0]}')
    assert (done.stdout, done.stderr) == (b"0\n", b"")


@pytest.mark.parametrize(
    ("least", "words"),
    [
        (6, ("check", "--config", str(TRACTOR))),
        (1, ("watch", "--set", "bus.interface=virtual", "--seconds", "0.1")),  # one line for what stays the same
        (6, ("decisions", "--help")),
    ],
)
def test_a_terminal_that_knows_only_ascii_gets_all_it_can_show(least, words):
    done = run(*words, PYTHONUTF8="0", PYTHONCOERCECLOCALE="0", LC_ALL="C")
    assert (done.returncode, done.stderr) == (0, b"")
    assert done.stdout.isascii()
    assert len(done.stdout.splitlines()) >= least


def test_a_name_that_is_no_text_is_a_name(log, tmp_path):
    path = os.fsencode(tmp_path) + b"/dri\xffve.log"
    Path(os.fsdecode(path)).write_bytes(log.read_bytes())
    done = run("replay", "--config", str(TRACTOR), path, "--report", str(tmp_path / "r.html"), LC_ALL="C.UTF-8")
    assert (done.returncode, done.stderr) == (0, b"")
    assert "dri\\udcffve.log" in (tmp_path / "r.html").read_text(encoding="utf-8")
    gone = run("replay", "--config", str(TRACTOR), path + b"x", LC_ALL="C.UTF-8")
    assert gone.returncode == 1
    assert "dri" in one_line(gone)


def test_too_few_files_are_one_line(log):
    done = run("replay", "--config", str(TRACTOR), str(log), shell='ulimit -n 7; "$@"')
    assert done.returncode == 1
    assert "Too many open files" in one_line(done)


WAITS = "import os, time; os.write(1, b'here'); time.sleep(60)"


def test_an_interrupt_while_the_program_loads_ends_it_as_signals_do(tmp_path):
    (tmp_path / "argparse.py").write_text(WAITS)  # in the place of one that is loaded early
    child = started(*PROGRAM, "check", "--config", str(FIELD), PYTHONPATH=f"{tmp_path}{os.pathsep}{PATH['PYTHONPATH']}")
    assert child.stdout.read(4) == b"here"
    child.send_signal(signal.SIGINT)
    assert child.communicate(timeout=LONGEST) == (b"", b"")
    assert child.returncode == -signal.SIGINT


def started(*command: str, **environment: str) -> subprocess.Popen[bytes]:
    return subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, stdin=subprocess.PIPE, start_new_session=True,
        env=ENVIRONMENT | PATH | environment,
    )  # fmt: skip


def until(holds, longest: float = LONGEST) -> None:
    end = time.monotonic() + longest
    while not holds():
        assert time.monotonic() < end
        time.sleep(0.01)


def is_alive(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def children(pid: int) -> list[int]:
    """Processes that work for one; what multiprocessing keeps its books with is none."""
    found = []
    for path in Path("/proc").glob("[0-9]*"):
        try:
            parent = int((path / "stat").read_text().rpartition(")")[2].split()[1])
            if parent == pid and b"resource_tracker" not in (path / "cmdline").read_bytes():
                found.append(int(path.name))
        except OSError:
            continue
    return found


POOL = """
import os, sys, time
from soilbus.workers import workers
if __name__ == "__main__":
    with workers(2, sys.argv[1], time.sleep, 0.0) as pool:
        futures = [pool.submit(time.sleep, 60.0) for _ in range(2)]
        while not all(f.running() for f in futures) or len(pool._processes) < 2:
            time.sleep(0.01)
        print("here", flush=True)
        time.sleep(60.0)
"""
BESIDE = """
import os, time
from soilbus.offline.replay import estimator_beside
from soilbus.simulator.reference import reference_configuration
os.cpu_count = lambda: 2
with estimator_beside(reference_configuration()) as worker:
    worker.submit(time.sleep, 60.0)
    print("here", flush=True)
    time.sleep(60.0)
"""


@pytest.mark.parametrize(("code", "method", "count"), [(POOL, "fork", 2), (POOL, "spawn", 2), (BESIDE, "", 1)])
def test_workers_die_with_a_killed_parent(code, method, count, tmp_path):
    (tmp_path / "pool.py").write_text(code)
    parent = started(sys.executable, str(tmp_path / "pool.py"), method)
    assert parent.stdout.read(4) == b"here"
    until(lambda: len(children(parent.pid)) == count)
    working = children(parent.pid)
    parent.kill()
    parent.wait(LONGEST)
    until(lambda: not any(is_alive(pid) for pid in working))


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupt_of_the_whole_group_ends_all_without_a_word(number):
    parent = started(*PROGRAM, "decisions", "--drives", "40")
    until(lambda: len(children(parent.pid)) >= 2 or (os.cpu_count() or 1) < 2)
    working = children(parent.pid)
    os.killpg(parent.pid, number)
    assert parent.communicate(timeout=LONGEST) == (b"", b"")
    assert parent.returncode == -number
    until(lambda: not any(is_alive(pid) for pid in working))


WRITES = """
import sys
from pathlib import Path
from soilbus.files import whole_file
from soilbus.can.log_writer import write_log
import can

def frames():
    for i in range(10_000):
        yield can.Message(timestamp=1.7e9 + i / 1000.0, arbitration_id=0x123, data=bytes(8))
    print("here", flush=True)
    sys.stdin.read()

path = Path(sys.argv[1])
if path.suffix == ".json":
    with whole_file(path) as out:
        out.writelines(str(frame) for frame in frames())
else:
    write_log(frames(), path)
"""


@pytest.mark.parametrize("name", ["drive.log.gz", "drive.blf", "windows.json"])
def test_a_file_that_was_being_written_when_the_process_was_killed_is_not_there(name, tmp_path):
    writer = started(sys.executable, "-c", WRITES, str(tmp_path / name))
    assert writer.stdout.read(4) == b"here"
    writer.kill()
    writer.wait(LONGEST)
    assert not (tmp_path / name).exists()


HUNG = """
import os, sys, threading
def fsync(descriptor):
    os.write(1, b"here")
    threading.Event().wait()
os.fsync = fsync
from soilbus.__main__ import program
program()
"""


def test_a_disk_that_hangs_does_not_keep_the_service_from_ending(tmp_path):
    settings = ("--set", "bus.interface=virtual", "--set", "bus.channel=hung")
    words = ("run", "--config", str(TRACTOR), *settings)
    service = started(sys.executable, "-c", HUNG, *words, STATE_DIRECTORY=str(tmp_path))
    assert service.stdout.read(4) == b"here"
    begin = time.monotonic()
    service.terminate()
    service.communicate(timeout=LONGEST)
    assert service.returncode == 0
    assert time.monotonic() - begin < 10.0  # as long as systemd waits
