"""The pages of this version of soilbus: those in `docs`, and the README of `dbc` and of `systemd`."""

from __future__ import annotations

from pathlib import Path

PACKAGE = Path(__file__).resolve().parents[1]
PLACES = (PACKAGE, PACKAGE.parent, PACKAGE.parents[1])
"""Where `docs`, `dbc` and `systemd` lie: in the installed package; in a checkout beside it or at the top."""


def pages() -> dict[str, Path]:
    """Return the file of each page by its name."""
    found = {path.stem: path for path in sorted(_folder("docs").glob("*.md"))}
    return found | {name: _folder(name) / "README.md" for name in ("dbc", "systemd")}


def overview() -> str:
    """Return name and heading of each page, and where the files are."""
    rows = [f"{name:16}{_heading(path)}\n" for name, path in pages().items()]
    return "".join(rows) + f"\nsoilbus docs PAGE prints one; they lie in {_folder('docs')}\n"


def _folder(name: str) -> Path:
    return next(place / name for place in PLACES if (place / name).is_dir())


def _heading(page: Path) -> str:
    lines = page.read_text(encoding="utf-8").splitlines()
    return next(line.removeprefix("# ") for line in lines if line.startswith("# "))
