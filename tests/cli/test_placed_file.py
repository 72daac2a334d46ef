"""Files that are there whole or not at all."""

import os
import threading
from pathlib import Path
from typing import Any

import pytest

from soilbus.files import NotWritten, placed, whole_file, whole_file_of_bytes


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return tmp_path


def put(path: Path, content: bytes) -> None:
    with placed(path) as descriptor:
        os.write(descriptor, content)


def test_a_file_takes_the_place_of_the_one_before(folder: Path):
    path = folder / "out"
    for content in (b"first and longer", b"second"):
        put(path, content)
        assert path.read_bytes() == content
        assert list(folder.iterdir()) == [path]


def test_the_users_mask_holds(folder: Path):
    before = os.umask(0o027)
    try:
        put(folder / "out", b"x")
    finally:
        os.umask(before)
    assert (folder / "out").stat().st_mode & 0o777 == 0o640


def test_what_fails_leaves_the_one_before(folder: Path):
    path = folder / "out"
    put(path, b"first")
    with pytest.raises(TypeError), placed(path) as descriptor:
        os.write(descriptor, "no bytes")
    assert path.read_bytes() == b"first"
    assert list(folder.iterdir()) == [path]


def test_a_link_stays_one(folder: Path):
    (folder / "real").write_bytes(b"first")
    (folder / "link").symlink_to("real")
    put(folder / "link", b"second")
    assert (folder / "link").is_symlink()
    assert (folder / "real").read_bytes() == b"second"


def test_a_pipe_and_a_device_are_written_to_and_stay(folder: Path):
    os.mkfifo(folder / "pipe")
    heard: list[bytes] = []
    reader = threading.Thread(target=lambda: heard.append((folder / "pipe").read_bytes()))
    reader.start()
    put(folder / "pipe", b"said")
    reader.join(10.0)
    assert heard == [b"said"]
    assert (folder / "pipe").is_fifo()
    put(Path("/dev/null"), b"lost")
    assert Path("/dev/null").is_char_device()


def test_two_files_of_one_folder_can_be_written_at_once(folder: Path):
    with whole_file(folder / "one") as one, whole_file(folder / "other") as other:
        one.write("1")
        other.write("2")
    assert {path.name: path.read_text() for path in folder.iterdir()} == {"one": "1", "other": "2"}


@pytest.mark.parametrize("opened", [whole_file, whole_file_of_bytes])
def test_a_file_that_cannot_be_written_to_its_end_is_none(folder: Path, opened: Any):
    with pytest.raises(NotWritten, match="out: no space"), opened(folder / "out") as out:
        raise OSError(f"no space after {out.tell()} bytes")
    assert list(folder.iterdir()) == []


def test_a_folder_that_is_not_there_is_one_line(folder: Path):
    with pytest.raises(NotWritten, match=r"no/out: No such file or directory"), whole_file(folder / "no/out") as out:
        out.write("x")
