"""The C reader of dbc/README.md."""

import re
import shutil
import subprocess
from pathlib import Path

import pytest

from availability import unavailable

PAGE = Path(__file__).resolve().parents[2] / "dbc" / "README.md"


@pytest.fixture(scope="session")
def verdict_reader(tmp_path_factory) -> Path:
    """The page's C blocks, compiled as the page says."""
    if shutil.which("gcc") is None:
        unavailable("no gcc")
    page, folder = PAGE.read_text(encoding="utf-8"), tmp_path_factory.mktemp("verdict")
    (folder / "verdict.c").write_text("\n".join(re.findall(r"```c\n(.*?)```", page, re.S)), encoding="utf-8")
    command = re.search(r"`(gcc [^`]*?) && \./verdict < sample\.log`", page)[1]
    subprocess.run([*command.split(), "-Wextra", "-pedantic"], cwd=folder, check=True)
    return folder / "verdict"
