"""The package as others take it: version, types, public names, citation, what wheel and sdist hold."""

import ast
import email
import importlib
import inspect
import os
import re
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path
from types import ModuleType

import pytest

import soilbus
from soilbus.cli.main import main
from soilbus.daemon.service import software_version

REPO = Path(__file__).resolve().parents[2]
PUBLIC = (
    "soilbus",
    *(
        f"soilbus.{name}"
        for name in (
            "terra.wheel", "terra.soils", "terra.vehicle", "terra.soil_laws", "estimation.window",
            "estimation.posterior", "estimation.multistart", "estimation.tracker", "diagnosis.diagnose",
            "diagnosis.records", "offline.replay", "offline.diagnose", "config.model", "config.file",
            "pipeline.pipeline", "decision.capability", "decision.traversability", "simulator.recording",
            "simulator.scenario", "api.wheel", "api.estimate", "api.recordings", "api.paper",
        )
    ),
)  # fmt: skip


def described_constants(module: ModuleType) -> set[str]:
    """Names that a module assigns, each with a string right below that says what it is; imported ones too."""
    body = ast.parse(Path(inspect.getsourcefile(module) or "").read_text()).body
    found: set[str] = set()
    for node, below in zip(body, [*body[1:], None], strict=True):
        targets = (
            node.targets if isinstance(node, ast.Assign) else [node.target] if isinstance(node, ast.AnnAssign) else []
        )
        text = (
            isinstance(below, ast.Expr) and isinstance(below.value, ast.Constant) and isinstance(below.value.value, str)
        )
        if text:
            found |= {target.id for target in targets if isinstance(target, ast.Name)}
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("soilbus."):
            constants = [alias.name for alias in node.names if alias.name.isupper()]
            if constants:
                found |= described_constants(importlib.import_module(str(node.module))) & set(constants)
    return found


@pytest.mark.parametrize("name", PUBLIC)
def test_every_public_name_is_there_and_described(name: str) -> None:
    module = importlib.import_module(name)
    assert (module.__doc__ or "").strip()
    assert len(set(module.__all__)) == len(module.__all__) > 0
    assert [n for n in module.__all__ if n.startswith("_") and n != "__version__"] == []
    assert [n for n in module.__all__ if isinstance(getattr(module, n), ModuleType)] == []
    described = described_constants(module)
    for public in module.__all__:
        value = getattr(module, public)
        if inspect.isclass(value) or inspect.isfunction(inspect.unwrap(value)):
            text = value.__doc__ or ""
            assert text.strip(), public
            assert not text.startswith(f"{public}("), (
                f"{public}: the signature alone, as dataclass and NamedTuple write it"
            )
        else:
            assert public in described, public


def test_the_version_is_said(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["--version"])
    assert ended.value.code == 0
    assert capsys.readouterr().out == f"soilbus {soilbus.__version__}\n"
    assert re.fullmatch(r"\d+\.\d+\.\d+", soilbus.__version__)


def test_the_changelog_has_this_version_and_what_came_since() -> None:
    text = (REPO / "CHANGELOG.md").read_text()
    heads = re.findall(r"^## \[(.+?)\](?: - (\d{4}-\d{2}-\d{2}))?$", text, re.MULTILINE)
    assert heads[0] == ("Unreleased", "")
    assert heads[1][0] == soilbus.__version__
    assert all(date for _, date in heads[1:])
    assert set(re.findall(r"^### (.+)$", text, re.MULTILINE)) <= {
        "Added", "Changed", "Deprecated", "Removed", "Fixed", "Security", "Known limits",
    }  # fmt: skip


def test_the_citation_parses_and_names_the_paper() -> None:
    yaml = pytest.importorskip("yaml")
    cited = yaml.safe_load((REPO / "CITATION.cff").read_text())
    assert {"cff-version", "message", "title", "authors"} <= cited.keys()  # what the format asks for
    assert (cited["cff-version"], cited["type"], cited["license"]) == ("1.2.0", "software", "Apache-2.0")
    assert cited["authors"] == [{"name": "the soilbus authors"}]
    assert tuple(map(int, cited["version"].split("."))) == software_version()
    assert cited["version"] == soilbus.__version__
    (paper,) = cited["references"]
    assert {"type", "title", "authors"} <= paper.keys()
    assert (paper["authors"][0]["family-names"], paper["year"], paper["volume"], paper["start"]) == (
        "Xi", 2024, 15, "217",
    )  # fmt: skip


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the wheel and the sdist of this checkout."""
    pytest.importorskip("hatchling")
    out = tmp_path_factory.mktemp("dist")
    command = [sys.executable, "-m", "hatchling", "build", "-d", str(out), "-t", "wheel", "-t", "sdist"]
    subprocess.run(command, cwd=REPO, check=True, capture_output=True, timeout=120.0)
    return out


def test_wheel_and_sdist_have_the_types_the_version_and_their_requirements(built: Path) -> None:
    (wheel,) = built.glob("*.whl")
    with zipfile.ZipFile(wheel) as package:
        names = set(package.namelist())
        (metadata,) = (n for n in names if n.endswith(".dist-info/METADATA"))
        said = email.message_from_bytes(package.read(metadata))
    assert "soilbus/py.typed" in names
    assert not {part for name in names for part in name.split("/")} & {"tests", "lab", "validation"}
    assert said["Version"] == soilbus.__version__
    needed = [text for text in said.get_all("Requires-Dist", []) if "extra ==" not in text]
    assert any(re.match(r"scipy\b", text) for text in needed)
    (sdist,) = built.glob("*.tar.gz")
    with tarfile.open(sdist) as package:
        names = {name.partition("/")[2] for name in package.getnames()}
    assert {"CHANGELOG.md", "CITATION.cff", "LICENSE", "README.md", "service/soilbus/py.typed"} <= names


def test_the_installed_wheel_prints_its_own_pages_and_has_their_pictures(built: Path, tmp_path: Path) -> None:
    (wheel,) = built.glob("*.whl")
    with zipfile.ZipFile(wheel) as package:
        package.extractall(tmp_path)

    def docs(*page: str) -> str:
        command = [sys.executable, "-m", "soilbus", "docs", *page]
        environment = os.environ | {"PYTHONPATH": str(tmp_path)}
        done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=60.0)
        assert done.returncode == 0, done.stderr
        return done.stdout

    overview = docs()
    assert f"they lie in {tmp_path / 'soilbus/docs'}\n" in overview
    pages = {path.stem for path in (REPO / "service/docs").glob("*.md")} | {"dbc", "systemd"}
    assert {line.split()[0] for line in overview.partition("\n\n")[0].splitlines()} == pages
    assert docs("json") == (REPO / "service/docs/json.md").read_text()
    assert docs("systemd") == (REPO / "systemd/README.md").read_text()
    pictures = {path.name for path in (REPO / "service/docs").iterdir() if path.suffix in (".svg", ".png")}
    assert pictures <= {path.name for path in (tmp_path / "soilbus/docs").iterdir()}


def test_a_page_that_is_not_there_is_one_line_with_the_nearest(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["docs", "jsn"]) == 2
    assert capsys.readouterr().err == "soilbus: no page jsn; did you mean json?\n"
