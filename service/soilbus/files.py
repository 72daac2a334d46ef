"""Bounded reading of files that a user names, and outputs that are there whole or not at all.

    file -> opened() -> plain bytes of a packed file -> text_lines()      streams: only ratios and lines are bounded
                     -> read_unpacked()                                   what must be in memory as a whole

What is read may be a device without end, a pipe, a folder, or made to fill the memory; what is written stays whole even
when its process is killed.
"""

from __future__ import annotations

import bz2
import codecs
import errno
import gzip
import io
import lzma
import os
import stat
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from itertools import count
from pathlib import Path
from typing import IO, Any

from soilbus.words import WorkError, shown


@dataclass(frozen=True, slots=True)
class Limits:
    """Limits on what a file may ask of the machine that reads it; a log's size has none."""

    ratio: float = 250.0
    """Unpacked bytes for each packed byte.  A candump log of a parked machine with constant data, 400 000 lines:
    gzip 20, bzip2 51, zstd 107, xz 194; a deflate bomb has 1030, the others more."""
    free: int = 16 * 2**20
    """Unpacked bytes that any file may have, whatever its ratio: read in a second."""
    line: int = 1 << 16
    """Characters of a line: a frame of CAN FD takes 200, a comment in a log seldom a thousand."""
    block: int = 64 * 2**20
    """Bytes of a block that its format unpacks at once.  BLF and MF4 writers use 128 KiB to 4 MiB."""
    whole: int = 128 * 2**20
    """Unpacked bytes of a file that must be in memory as a whole: a table of 10 million cells, 1 GB as objects."""


LIMITS = Limits()


def read_bounded(path: Path, largest: int, regular: bool = True) -> bytes:
    """Return the content of a file of `largest` bytes at most; with `regular` of a regular file only.

    Raises OSError with a reason that can be printed.
    """
    descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC | (os.O_NONBLOCK if regular else 0))
    with open(descriptor, "rb") as file:
        if regular and not stat.S_ISREG(os.fstat(descriptor).st_mode):
            raise OSError(errno.EINVAL, "not a regular file", str(path))
        return read_all(file, largest, str(path))


def read_all(file: IO[bytes], largest: int = LIMITS.whole, name: str = "") -> bytes:
    """Return the rest of a file; OSError where it has more than `largest` bytes."""
    content = file.read(largest + 1)
    if len(content) > largest:
        raise OSError(errno.EFBIG, f"larger than {largest / 2**20:g} MiB", name)
    return content


@contextmanager
def opened(path: Path) -> Iterator[io.BufferedReader]:
    """Open the plain bytes of a file, packed or not, as a stream; "-" is standard input.

    Packing (gzip, bzip2, xz, zstd) is recognised by its first bytes.  Raises OSError where the file cannot be read;
    reading raises ValueError where it is damaged, cut off, or more than its limits allow.
    """
    is_stdin = str(path) == "-"
    with (
        open(sys.stdin.fileno() if is_stdin else path, "rb", buffering=0, closefd=not is_stdin) as file,
        plain_bytes(file) as stream,
    ):
        yield stream


def plain_bytes(file: Any) -> io.BufferedReader:
    """Return a stream of the plain bytes of an unbuffered binary file, which may be packed; as `opened`."""
    packed = _Counted(file)
    return io.BufferedReader(_Unpacked(packed), _BUFFER)


def packing(stream: io.BufferedReader) -> str:
    """Return how the file of a stream of `opened` is packed, such as "gzip"; empty where it is not."""
    return stream.raw.packing if isinstance(stream.raw, _Unpacked) else ""


def text_lines(stream: io.BufferedReader) -> Iterator[str]:
    """Yield the lines of a text file; ValueError for one longer than `Limits.line`.

    UTF-8, or UTF-16 with its byte order mark; other bytes are of Windows' code page, as programs there write them.
    """
    is_wide = stream.peek(2)[:2] in (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)
    text = io.TextIOWrapper(stream, "utf-16" if is_wide else "utf-8-sig", errors="cp1252")
    for line in iter(partial(text.readline, LIMITS.line), ""):
        if len(line) == LIMITS.line and line[-1] != "\n":
            raise ValueError(f"a line of more than {LIMITS.line} characters")
        yield line


def _of_code_page(error: UnicodeError) -> tuple[str, int]:
    if not isinstance(error, UnicodeDecodeError) or error.encoding.startswith("utf-16"):
        raise error
    return error.object[error.start : error.end].decode("cp1252", "replace"), error.end


codecs.register_error("cp1252", _of_code_page)


def within_ratio(packed: float, plain: float) -> None:
    """Raise ValueError where packed bytes stand for more plain ones than `Limits.ratio` allows."""
    if plain > LIMITS.free + LIMITS.ratio * packed:
        raise ValueError(f"it unpacks to more than {LIMITS.ratio:g} times its size")


_BUFFER = 1 << 16
_PIECE = 1 << 12  # of a damaged file no more good bytes are lost


class _Counted(io.RawIOBase):
    """An unbuffered file, from its present place on, that counts the bytes read; its first ones can be looked at."""

    def __init__(self, file: Any) -> None:
        self._file, self.count, self.head = file, 0, b""
        while len(self.head) < 6 and (more := file.read(_BUFFER)):
            self.head += more
        self._left = self.head

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: Any) -> int:
        data = self._left[: len(buffer)] or self._file.read(len(buffer)) or b""
        self._left = self._left[len(data) :]
        buffer[: len(data)] = data
        self.count += len(data)
        return len(data)


class _Unpacked(io.RawIOBase):
    """Plain bytes of a packed file; ValueError where it is damaged or has more of them than its size allows."""

    def __init__(self, packed: _Counted) -> None:
        self._packed, self.count = packed, 0
        kinds = [kind for kind, mark in _MARKS.items() if packed.head.startswith(mark)]
        self.packing = kinds[0] if kinds else ""
        self._read: Callable[[int], bytes] = packed.read
        if self.packing == "gzip":
            self._read = gzip.GzipFile(fileobj=packed).read1
        elif self.packing == "bzip2":
            self._read = bz2.BZ2File(packed).read1
        elif self.packing == "xz":
            self._read = lzma.LZMAFile(packed).read1  # type: ignore[arg-type]  # noqa: SIM115
        elif self.packing == "zstd":
            try:
                plain = import_module("pyarrow").input_stream(packed, compression="zstd")
            except ModuleNotFoundError:
                raise OSError(errno.ENOSYS, "a file packed by zstd needs the extra soilbus[tables]") from None
            self._read = lambda size: plain.read(min(size, _PIECE))

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: Any) -> int:
        try:
            plain = self._read(len(buffer))
        except MemoryError:
            raise
        except Exception as error:  # each decoder has its own
            if isinstance(error, OSError) and error.errno is not None:
                raise
            raise ValueError(f"{self.packing} data: {' '.join(str(error).split())}") from None
        buffer[: len(plain)] = plain
        self.count += len(plain)
        if self.packing:
            within_ratio(self._packed.count, self.count)
        return len(plain)


_MARKS = {"gzip": b"\x1f\x8b", "bzip2": b"BZh", "xz": b"\xfd7zXZ\0", "zstd": b"\x28\xb5\x2f\xfd"}

_numbers = count()


@contextmanager
def placed(path: Path) -> Iterator[int]:
    """Give a descriptor of a new file that gets its name when the context ends without an exception.

    What was there before is replaced then; a link stays one, and what is no regular file is written to as it is.
    Until then the file has a hidden name beside. The descriptor is the context's to close. Raises OSError.
    """
    path = Path(os.path.realpath(path))
    if path.exists() and not stat.S_ISREG(path.stat().st_mode):
        with _closing(os.open(path, os.O_WRONLY | os.O_CLOEXEC)) as descriptor:
            yield descriptor
        return
    spare = path.with_name(f".soilbus-{os.getpid()}-{next(_numbers)}")
    flags = os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_NOFOLLOW | os.O_CLOEXEC
    with _closing(os.open(spare, flags, 0o666)) as descriptor:
        try:
            yield descriptor
            os.replace(spare, path)
        except BaseException:
            spare.unlink(missing_ok=True)
            raise


@contextmanager
def _closing(descriptor: int) -> Iterator[int]:
    try:
        yield descriptor
    finally:
        os.close(descriptor)


class NotWritten(WorkError):
    """Error of a file that cannot be written; the text is one line for the user."""

    def __init__(self, text: str) -> None:
        super().__init__(shown(text))


@contextmanager
def whole_file(path: Path) -> Iterator[IO[str]]:
    """Open a text file that appears under its name only when it is complete; "-" is stdout.

    Raises NotWritten where it cannot be, and then there is none.
    """
    if str(path) == "-":
        yield sys.stdout
        return
    try:
        # a file's name need not be UTF-8: it is shown by its codes then
        with (
            placed(path) as descriptor,
            open(descriptor, "w", encoding="utf-8", errors="backslashreplace", closefd=False) as out,
        ):
            yield out
    except OSError as error:
        raise NotWritten(f"{path}: {error.strerror or error}") from None


def write_text(path: Path, text: str) -> None:
    """Write a text file as `whole_file` does."""
    with whole_file(path) as out:
        out.write(text)


@contextmanager
def whole_file_of_bytes(path: Path) -> Iterator[IO[bytes]]:
    """Open a binary file that appears under its name only when it is complete.

    Raises NotWritten where it cannot be, and then there is none.
    """
    try:
        with placed(path) as descriptor, open(descriptor, "wb", closefd=False) as out:
            yield out
    except OSError as error:
        raise NotWritten(f"{path}: {error.strerror or error}") from None
