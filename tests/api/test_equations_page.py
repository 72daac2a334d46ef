"""The page of equations: each names its module and its source, and every effect of the catalogue has its row."""

import re
from pathlib import Path

from soilbus.terra.effects.catalogue import CATALOGUE

PAGE = (Path(__file__).resolve().parents[2] / "service/docs/equations.md").read_text(encoding="utf-8")


def test_each_equation_names_its_module_and_its_source():
    after = [text.lstrip("\n").partition("\n")[0] for text in re.split(r"```math\n[^`]*```\n", PAGE)[1:]]
    assert len(after) > 20
    for line in filter(None, after):  # nothing is between two equations of one source
        assert re.match(r"\[\w+/\w+\.py\]\(\.\./soilbus/\w+/\w+\.py\).* · \S+", line), line


def test_math_is_balanced_and_each_effect_has_its_equation():
    blocks = re.findall(r"```math\n([^`]*)```", PAGE) + re.findall(r"\$`([^`]+)`\$", PAGE)
    assert len(blocks) > 100
    for block in blocks:
        assert block.count("{") == block.count("}")
        assert block.count(r"\left") - block.count(r"\leftarrow") == block.count(r"\right")
        assert block.count(r"\begin") == block.count(r"\end")
    for line in PAGE.splitlines():
        assert line.count("$") % 2 == 0, line
    rows = [line for line in PAGE.splitlines() if line.startswith("| `")]
    assert set(re.findall(r"`(\w+)`", " ".join(row.split("|")[1] for row in rows))) == set(CATALOGUE)
