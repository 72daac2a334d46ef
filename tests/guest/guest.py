#!/usr/bin/env python3
"""A guest kernel with vcan (Debian's User-Mode Linux): no KVM, an ordinary process.

    guest.py setup [--debian]     fetch the kernel, once; also a bare Debian

`run` runs a command in it, where vcan0 is up.  The guest sees this machine's files; what it writes is lost, except
under `rw`.  With `units` it boots this machine's systemd as PID 1 (needs root) with these units.
`run(base=bare_debian())` boots the systemd of a bare Debian instead, which has nothing of this machine.
"""

from __future__ import annotations

import argparse
import contextlib
import hashlib
import os
import platform
import shlex
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterable, Sequence
from pathlib import Path

HERE = Path(__file__).resolve().parent
PACKAGES = ("user-mode-linux", "busybox-static")
MODULES = ("can", "can-raw", "can-bcm", "can-dev", "vcan", "overlay", "autofs4")  # in the order of loading
DEBIAN = ("systemd", "python3-venv", "iproute2")  # what a bare one has besides apt; no network in there
ENVIRONMENT = ("PATH", "HOME", "LANG", "VIRTUAL_ENV", "PYTHONPATH", "OMP_NUM_THREADS")
OF_BARE_DEBIAN = {"PATH": "/usr/sbin:/usr/bin:/sbin:/bin", "HOME": "/root", "DEBIAN_FRONTEND": "noninteractive"}
MEMORY = 1536  # MiB; half of it for what is written
NO_STATUS = 125  # the guest ended without the command's exit status
SYSTEMD = ("fstab=no", "systemd.gpt_auto=no", "systemd.getty_auto=no", "systemd.firstboot=off",
           "systemd.show_status=no", "systemd.mask=systemd-binfmt.service",
           "systemd.mask=proc-sys-fs-binfmt_misc.automount")  # fmt: skip
# Whatever ends this process, SIGKILL too, ends the guest: the pipe to the guard closes then.
GUARDED = 'exec 3<&0; (read _ <&3; kill -9 0) & exec "$@" </dev/null 3<&-'


class Unavailable(Exception):
    """This machine cannot boot the guest, in one line."""


def cache_dir() -> Path:
    """Where the guest lies once set up; another version of the harness has another place."""
    parts = b"".join((HERE / name).read_bytes() for name in ("guest-init", "fpshim.c"))
    base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(base) / "soilbus-guest" / hashlib.sha256(parts + repr(MODULES).encode()).hexdigest()[:12]


def prepare() -> Path:
    """The guest's folder, set up if it is not yet; raises Unavailable."""
    cache = cache_dir()
    if not cache.exists():
        cache.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=cache.parent) as tmp:
            _build(Path(tmp))
            (Path(tmp) / "guest").rename(cache)
    return cache


def bare_debian() -> Path:
    """Root of a bare Debian of this machine's release, made if it is not there yet (needs root); raises Unavailable."""
    release = platform.freedesktop_os_release()
    root = cache_dir().parent / f"{release.get('VERSION_CODENAME')}-{'-'.join(DEBIAN)}"
    if root.exists():
        return root
    if release["ID"] != "debian" or os.getuid() or not shutil.which("debootstrap"):
        raise Unavailable("a bare Debian can only be set up on Debian, as root, with debootstrap")
    root.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=root.parent) as tmp:
        made = Path(tmp) / "root"
        alone = ["unshare", "--mount"]  # what it mounts in there goes with it, however it ends
        what = ["--variant=minbase", f"--include={','.join(DEBIAN)}", release["VERSION_CODENAME"], made]
        if fault := _call([*alone, "debootstrap", *what], Path(tmp)):
            raise Unavailable(f"a bare Debian cannot be set up: {fault}")
        made.rename(root)
    return root


def _build(tmp: Path) -> None:
    for tool in ("apt-get", "dpkg", "cc"):
        if not shutil.which(tool):
            raise Unavailable(f"the guest kernel cannot be set up: no {tool} here")
    apt = ["apt-get", "-qq", "-o", "APT::Sandbox::User=root", "-o", "Acquire::http::Timeout=30"]
    if _call([*apt, "download", *PACKAGES], tmp):
        _call([*apt, "update"], tmp)  # its own complaints may be about other sources
        if fault := _call([*apt, "download", *PACKAGES], tmp):
            raise Unavailable(f"the guest kernel cannot be downloaded: {fault}")
    for deb in tmp.glob("*.deb"):
        subprocess.run(["dpkg", "-x", deb, tmp / "deb"], check=True)
    root = tmp / "guest/root"
    for folder in ("bin", "modules", "proc", "sys", "dev", "host", "layer", "new"):
        (root / folder).mkdir(parents=True)
    modules = {path.stem: path for path in (tmp / "deb").rglob("*.ko")}
    for i, name in enumerate(MODULES):
        shutil.copy(modules[name], root / f"modules/{i}-{name}.ko")
    shutil.copy(next((tmp / "deb").rglob("bin/busybox")), root / "bin")
    shutil.copy(tmp / "deb/usr/bin/linux.uml", tmp / "guest")
    shutil.copy(HERE / "guest-init", root / "init")
    (root / "init").chmod(0o755)
    if fault := _call(["cc", "-O2", "-shared", "-fPIC", "-o", tmp / "guest/fpshim.so", HERE / "fpshim.c"], tmp):
        raise Unavailable(f"the guest kernel's shim does not compile: {fault}")


def _call(command: Sequence[str | Path], cwd: Path) -> str:
    """Run it; the last line of its complaint if it failed, else nothing."""
    try:
        done = subprocess.run(command, cwd=cwd, capture_output=True, text=True, timeout=300)
    except subprocess.TimeoutExpired:
        return f"{command[0]} took more than 300 s"
    return (done.stderr.strip().splitlines() or [f"{command[0]} failed"])[-1] if done.returncode else ""


def run(
    command: Sequence[str | Path],
    *,
    rw: Iterable[Path] = (),
    units: Iterable[Path] = (),
    base: Path = Path("/"),
    timeout: float = 120.0,
) -> subprocess.CompletedProcess[str]:
    """Run a command in the guest, in this working directory; its two outputs come as one.

    Where `base` is not this machine's root, the guest sees those files alone and its own environment, the command
    runs in the first folder of `rw`, and systemd is PID 1.
    The exit status is the command's, or NO_STATUS if it ended by time-out or crash.
    Raises Unavailable if the guest cannot be set up.
    """
    cache = prepare()
    with tempfile.TemporaryDirectory(prefix="guest-") as tmp:
        job = Path(tmp)
        folders = [Path(d).resolve() for d in rw]
        ours = base == Path("/")
        environment = {k: os.environ[k] for k in ENVIRONMENT if k in os.environ} if ours else OF_BARE_DEBIAN
        words = ["env", "-i", *(f"{k}={value}" for k, value in environment.items()), *map(str, command)]
        here = os.getcwd() if ours else str(folders[0])
        (job / "command").write_text(f"cd {shlex.quote(here)} && exec {shlex.join(words)}\n")
        (job / "rw").write_text("".join(f"{folder}\n" for folder in folders))
        boot = ["rootfstype=hostfs", f"rootflags={cache / 'root'}", "ro", "init=/init", "loglevel=2", "panic=-1"]
        if (units := list(units)) or not ours:
            (job / "units").mkdir()
            for unit in units:
                shutil.copy(unit, job / "units")
            boot += SYSTEMD
        with (job / "console").open("wb") as console, (job / "output").open("wb") as captured:
            output = subprocess.Popen(  # through a pipe: the kernel makes its terminals non-blocking
                ["cat"], stdin=subprocess.PIPE, stdout=captured
            )
            kernel = subprocess.Popen(
                ["sh", "-c", GUARDED, "sh", cache / "linux.uml", f"mem={MEMORY}M", *boot, f"base={base}", f"job={job}",
                 f"umid={job.name}", f"uml_dir={job}/", "lsm=capability", "con=null", "con0=null,fd:2",
                 f"con1=null,fd:{_fd(output)}"],
                stdin=subprocess.PIPE, stdout=console, stderr=console, start_new_session=True,
                pass_fds=[_fd(output)], env={**os.environ, "LD_PRELOAD": str(cache / "fpshim.so"), **_memory_file()},
            )  # fmt: skip
            _keep_on_one_processor(kernel.pid)
        with contextlib.suppress(subprocess.TimeoutExpired):
            kernel.wait(timeout)
        kernel.communicate()
        output.communicate()
        text = (job / "output").read_text(errors="replace")
        if (job / "status").exists():
            return subprocess.CompletedProcess(list(command), int((job / "status").read_text()), text)
        text += f"the guest crashed or took more than {timeout:g} s\n"
        text += (job / "console").read_text(errors="replace")[-4000:]
        return subprocess.CompletedProcess(list(command), NO_STATUS, text)


def _keep_on_one_processor(kernel: int) -> None:
    """The guest has one, but its kernel and each of its processes are processes here that take turns.

    Where one turn's end must wake another processor a system call takes five times as long.
    """
    ours = sorted(os.sched_getaffinity(0))
    os.sched_setaffinity(kernel, {ours[os.getpid() % len(ours)]})  # several guests at a time find several


def _fd(process: subprocess.Popen[bytes]) -> int:
    assert process.stdin is not None
    return process.stdin.fileno()


def _memory_file() -> dict[str, str]:
    """The guest's memory is a sparse file in /dev/shm, which is small in most containers."""
    return {} if shutil.disk_usage("/dev/shm").free > MEMORY << 20 else {"TMPDIR": tempfile.gettempdir()}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    setup = parser.add_subparsers(dest="verb", required=True).add_parser("setup")
    setup.add_argument("--debian", action="store_true")
    given = parser.parse_args()
    try:
        print(prepare())
        if given.debian:
            print(bare_debian())
    except Unavailable as reason:
        print(reason, file=sys.stderr)
        return NO_STATUS
    return 0


if __name__ == "__main__":
    sys.exit(main())
