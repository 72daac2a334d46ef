"""The generated pages are those of the code, and links between the pages lead somewhere."""

import re
from pathlib import Path

import pytest

from reference_pages import pages
from soilbus.config.model import Config
from soilbus.terra.effects.catalogue import CATALOGUE

REPO = Path(__file__).resolve().parents[2]
DOCS = REPO / "service" / "docs"
PAGES = [
    *REPO.glob("*.md"),
    *DOCS.glob("*.md"),
    *(REPO / folder / "README.md" for folder in ("service", "dbc", "systemd")),
]


@pytest.fixture(scope="module")
def generated() -> dict[str, str]:
    return pages()


def test_the_generated_pages_are_up_to_date(generated: dict[str, str]) -> None:
    kept = {name: (DOCS / name).read_text(encoding="utf-8") for name in generated}
    assert kept == generated, "python tests/support/reference_pages.py service/docs"


def test_every_key_and_effect_has_its_row(generated: dict[str, str]) -> None:
    configuration, effects = generated["configuration.md"], generated["effects.md"]
    keys = {key for section in Config.model_fields.values() for key in getattr(section.annotation, "model_fields", ())}
    assert len(keys) > 50
    for key in keys - {"form"}:
        row = next(line for line in configuration.splitlines() if line.startswith(f"| `{key}` "))
        assert not row.endswith("|  |"), f"{key} has no meaning"
    for effect in CATALOGUE.values():
        (section,) = re.findall(rf"^## {effect.name}\n(.*?)(?=^## |\Z)", effects, re.MULTILINE | re.DOTALL)
        named = re.findall(r"`(\w+)`", "".join(re.findall(r"^\|([^|]*)\|", section, re.MULTILINE)))
        assert named == [parameter.name for parameter in effect.parameters]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(REPO)))
def test_links_lead_to_files(page: Path) -> None:
    links = re.findall(r"\]\((?!https?:)([^)#]+)(?:#[^)]*)?\)", page.read_text(encoding="utf-8"))
    links += re.findall(r'<img src="([^"]+)"', page.read_text(encoding="utf-8"))
    assert [link for link in links if not (page.parent / link).exists()] == []
