"""Each line of the threat model names tests that are there."""

import re
from pathlib import Path

REPO = Path(__file__).resolve().parents[2]
PAGE = (REPO / "service/docs/threats.md").read_text(encoding="utf-8")
ROWS = [[cell.strip() for cell in line.strip("|").split(" | ")] for line in PAGE.splitlines() if line.startswith("| ")]


def test_each_line_names_a_test_that_is_there() -> None:
    lines = [row for row in ROWS if row[-1] not in ("test", "---")]
    assert len(lines) >= 20
    assert {len(row) for row in lines} == {3}
    for *_, tests in lines:
        named = re.findall(r"`(tests/[\w/]+\.py)(?:::(\w+))?`", tests)
        assert named, tests
        for file, function in named:
            text = (REPO / file).read_text(encoding="utf-8")
            assert f"def {function or 'test_'}" in text, (file, function)
