"""Names are data: whatever files, signals, nodes, wheels and vehicles are called, no output is more than text.

Each output is read by the parser of its own format.  A name is one line at most, and nothing in it acts.
"""

import csv
import io
import json
import os
import random
import re
import shutil
import tomllib
import warnings
from collections.abc import Callable
from html.parser import HTMLParser
from pathlib import Path
from xml.etree import ElementTree

import pytest
import tomlkit
from hypothesis import given
from hypothesis import strategies as st

from soilbus.cli.main import main
from soilbus.config.edit import toml_text
from soilbus.config.file import machine, shipped_dbc
from soilbus.export.table import write_csv
from soilbus.terra.effects.catalogue import CATALOGUE
from soilbus.words import shown

SHORT = ["--set", "estimator.window=4"]
PIECES = (
    "\x1b[31m", "\x1b]0;owned\x07", "\nFORGED", "\r", "\t", '"', "'", "`$(id)`", "=1+1", "@x", "+1", "-1", "<b>",
    "<script>alert(1)</script>", "&amp;", "]]>", "\u202e", "\u2028", "\x85", "\x7f", "$\\frac{", "[red]", "[/red]",
    "{0}", "%s", "#", "\\", "ä", "名", "\N{TRACTOR}", "\ufffe", "a" * 40,
)  # fmt: skip
"""What acts in some format: terminal, CSV, TOML, HTML, XML, JSON, TeX, rich's markup, Python's formats, a shell."""
RNG = random.Random(47)
UNTIDY = [
    "=cmd|' /C calc'!A0", "-rf", "\x1b[2J\x1b[31mred\nFORGED<img src=x onerror=alert(1)>\u202e",
    "".join(RNG.sample(PIECES, 10)),
]  # fmt: skip
INJECTION = '"\n[mqtt]\nhost="evil.example"\n#'
HUGE = "n" * 10_000
NO_UTF8 = os.fsdecode(b"bytes\xff\xfe")


def each_of(*names: str) -> pytest.MarkDecorator:
    """A test for each name; its id is a number, which every terminal can show."""
    return pytest.mark.parametrize("name", names, ids=map(str, range(len(names))))


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Six seconds with a position."""
    path = tmp_path_factory.mktemp("drive") / "drive.log"
    assert main(["simulate", "--duration", "6", "--seed", "4", "--start", "48", "11", "--log", str(path)]) == 0
    return path


@pytest.fixture
def says(capfd: pytest.CaptureFixture[str]) -> Callable[..., tuple[int, str, str]]:
    """Runs a command, and looks at what it says: lines that are printable, none of which a name has made."""

    def run(*words: object) -> tuple[int, str, str]:
        capfd.readouterr()
        with warnings.catch_warnings():
            warnings.simplefilter("error", UserWarning)  # it would be printed as it is
            try:
                code = main([str(word) for word in words])
            except SystemExit as ended:  # of argparse
                code = int(str(ended.code))
        out, err = capfd.readouterr()
        for line in (out + err).split("\n"):
            assert line.isprintable(), line
            assert not line.startswith("FORGED"), out + err
            assert len(line) < 6000
        assert "Traceback" not in err
        return code, out, err

    return run


class Page(HTMLParser):
    """The elements of a page, and its texts."""

    def __init__(self) -> None:
        super().__init__()
        self.tags: set[str] = set()
        self.attributes: set[str] = set()
        self.text = ""

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.add(tag)
        self.attributes |= {name for name, _ in attrs}

    def handle_data(self, data: str) -> None:
        self.text += data


def check_page(path: Path, name: str) -> None:
    text = path.read_text(encoding="utf-8")
    page = Page()
    page.feed(text)
    assert not {"script", "b" * 40, "iframe"} & page.tags
    assert not {name for name in page.attributes if name.startswith("on")}
    assert all(line.isprintable() for line in text.split("\n"))
    assert name in page.text


@pytest.fixture
def logs(drive, tmp_path) -> list[Path]:
    """The drive under every untidy name, in a folder of such a name."""
    folder = tmp_path / UNTIDY[2]
    folder.mkdir()
    return [Path(shutil.copy(drive, folder / f"{name.replace('/', '_')}.log")) for name in UNTIDY]


def test_names_of_files_and_folders_are_text_in_every_output(logs, says):
    folder, labels = logs[0].parent, [shown(log.name) for log in logs]
    for log in logs:
        dbc, config, made = (folder / f"{log.stem}{suffix}" for suffix in (".dbc", ".toml", " made.toml"))
        shutil.copy(shipped_dbc("tractor.dbc"), dbc)
        document = tomlkit.parse(machine("tractor").read_text())
        document["dbc"]["input"] = [dbc.name]
        config.write_text(tomlkit.dumps(document))
        of = ["--config", config, *SHORT]
        beginning = folder / f"{log.stem} beginning.log"
        beginning.write_text("".join(log.read_text().splitlines(keepends=True)[:500]))
        assert says("check", *of, "--log", beginning)[0] == 0
        assert says("init", "--dbc", dbc, "--log", beginning, "-o", made)[0] == 0
        assert tomllib.loads(made.read_text(encoding="utf-8"))["dbc"]["input"] == [dbc.name]
        assert says("check", "--config", made)[0] == 2  # open values
    assert says("init", "--dbc", dbc)[0] == 0
    outputs = ["--json", "w.jsonl", "--report", "r.html", "--table", "t.csv", "--map", "m.geojson", "--isoxml", "iso"]
    there = [folder / word if "." in word or word == "iso" else word for word in outputs]
    frames = folder / f"{log.stem} sent.log"
    code, out, _ = says("replay", *of, *logs, *there, "--frames", frames)
    assert code == 0
    windows = [json.loads(line) for line in (folder / "w.jsonl").read_text().splitlines()]
    assert {window["log"] for window in windows} == set(labels)
    for label in labels:
        assert label in out
        check_page(folder / "r.html", label)
    with (folder / "t.csv").open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == len(windows)
    assert {row["log"].removeprefix("'") for row in rows} == set(labels)
    assert not {row["log"][0] for row in rows} & set("=+-@\t\r")
    points = json.loads((folder / "m.geojson").read_text())["features"]
    assert {point["properties"]["log"] for point in points} == set(labels)
    tasks = ElementTree.parse(folder / "iso/TASKDATA.XML").getroot().findall("TSK")
    assert [task.get("B") for task in tasks] == [f"soilbus {label}"[:32] for label in labels]
    assert says("watch", frames, "--speed", "1000", "--plain")[0] == 0
    code, out, _ = says("watch", frames, "--speed", "1000", "--json")
    assert code == 0
    assert all(json.loads(line) for line in out.splitlines())


def test_a_diagnosis_and_a_batch_show_names_as_text(logs, says, monkeypatch):
    monkeypatch.setattr("soilbus.offline.diagnose.possible_effects", lambda config: [CATALOGUE["grade"]])
    folder, logs = logs[0].parent, logs[:2]
    assert says("simulate", "--duration", "9", "--seed", "5", "--log", logs[1])[0] == 0
    found, page, model = (folder / each for each in ("d.json", "d.html", f"{logs[0].stem}.toml"))
    command = ["diagnose", "--config", "tractor", *SHORT, *logs, "--json", found, "--report", page]
    assert says(*command, "--model-out", model)[0] == 0
    assert {soil["log"] for soil in json.loads(found.read_text())["soils"]} == {shown(log.name) for log in logs}
    for log in logs:
        check_page(page, shown(log.name))
    assert tomllib.loads(model.read_text(encoding="utf-8"))["dbc"]["input"] == ["tractor.dbc"]
    pytest.importorskip("pyarrow")
    manifest = folder / "fleet.csv"
    bad = [folder / f"{log.stem} bad.log" for log in logs]
    with manifest.open("w", newline="", encoding="utf-8") as file:
        rows = csv.writer(file)
        rows.writerow(("log", "vehicle"))
        rows.writerow((logs[0].name, UNTIDY[0]))
        for each in bad:
            each.write_text("no log at all\n")
            rows.writerow((each.name, "=T7<b>"))
    code, out, _ = says("batch", "--config", "tractor", *SHORT, manifest, "--out", folder / f"{bad[0].stem} out")
    assert code == 0
    assert sum("not a CAN log" in line for line in out.splitlines()) == len(bad)
    assert all(shown(each.name) in out for each in bad)
    with manifest.open("w", newline="", encoding="utf-8") as file:
        csv.writer(file).writerows((("log", "vehicle"), (logs[0].name, "a\x1b[31m\nFORGED")))
    code, _, err = says("batch", "--config", "tractor", *SHORT, manifest, "--out", folder / "out")
    assert (code, err.count("\n")) == (1, 1)
    is_missing(says("batch", "--config", "tractor", folder / f"{NO_UTF8}.log", "--out", folder / NO_UTF8))


def is_missing(said: tuple[int, str, str]) -> None:
    """A command said in one line, or after its usage, what is not there."""
    code, _, err = said
    assert code in (1, 2)
    assert err.splitlines()[-1].startswith("soilbus")
    assert code == 2 or err.count("\n") == 1


@each_of(*UNTIDY, NO_UTF8)
@pytest.mark.parametrize(
    "words",
    [
        "check --config FILE.toml", "check --config tractor --log FILE.log", "replay --config tractor FILE.log",
        "replay --config tractor FILE.csv", "diagnose --config tractor FILE.log", "watch FILE.log --json",
        "init --dbc FILE.dbc", "run --config FILE.toml",
        "simulate --manoeuvre FILE.json --log FILE.log", "simulate --log FILE/no.log", "watch FILE.log extra FILE",
        "docs FILE", "effects FILE", "simulate --soil FILE --log x.log", "simulate --effect FILE=1 --log x.log",
        "check --config tractor --set FILE=1", "watch --json --channel FILE", "replay --config tractor FILE.log --FILE",
        "montecarlo --config FILE.toml", "decisions --config FILE.toml", "completion FILE", "paper --seed FILE",
        "demo --picture FILE/FILE.svg", "FILE",
    ],
)  # fmt: skip
def test_what_is_not_there_is_one_printable_line(words, name, tmp_path, monkeypatch, says):
    monkeypatch.chdir(tmp_path)
    named = name.replace("/", "_").lstrip("-")
    is_missing(says(*(word.replace("FILE", named) for word in words.split())))


DBC = """VERSION ""
NS_ :
BS_:
BU_: ECU
BO_ 256 Motion: 8 ECU
 SG_ GroundSpeed : 32|16@1+ (0.001,0) [0|60] "m/s" ECU
 SG_ PitchAngle : 0|16@1+ (0.001,-10) [-10|10] "rad" ECU
 SG_ GroundSpeedValid : 48|2@1+ (1,0) [0|3] "" ECU
CM_ SG_ 256 GroundSpeed "over ground";
BA_DEF_ SG_ "SystemSignalLongSymbol" STRING ;
BA_DEF_ BO_ "SystemMessageLongSymbol" STRING ;
BA_DEF_ BU_ "SystemNodeLongSymbol" STRING ;
BA_DEF_DEF_ "SystemSignalLongSymbol" "";
BA_DEF_DEF_ "SystemMessageLongSymbol" "";
BA_DEF_DEF_ "SystemNodeLongSymbol" "";
BA_ "SystemMessageLongSymbol" BO_ 256 "Motion";
BA_ "SystemSignalLongSymbol" SG_ 256 GroundSpeed "GroundSpeed";
BA_ "SystemNodeLongSymbol" BU_ ECU "ECU";
VAL_ 256 GroundSpeedValid 0 "bad" 1 "measured" 3 "open" ;
"""
NAMES_OF_DBC = ('BO_ 256 "Motion"', 'GroundSpeed "GroundSpeed"', 'BU_ ECU "ECU"')
TEXTS_OF_DBC = ('"rad"', '"over ground"', '"measured"', '"bad"', '"m/s"')


def quoted(name: str) -> str:
    return '"' + name.replace("\\", "").replace('"', '\\"') + '"'


@each_of(*UNTIDY, INJECTION, HUGE, "two words", "1st", "")
@pytest.mark.parametrize("place", NAMES_OF_DBC, ids=("message", "signal", "node"))
def test_a_name_in_a_dbc_that_is_no_identifier_is_one_line(place, name, tmp_path, says):
    before, _, _ = place.rpartition(" ")
    dbc = tmp_path / "made.dbc"
    dbc.write_text(DBC.replace(place, f"{before} {quoted(name)}"), encoding="utf-8")
    out = tmp_path / "made.toml"
    for command in (
        ["init", "--dbc", dbc, "-o", out],
        ["check", "--config", "tractor", "--set", f'dbc.input=["{dbc}"]'],
    ):
        code, _, err = says(*command)
        assert (code, err.count("\n")) == (2, 1)
        assert "made.dbc: not a DBC file: " in err
    assert not out.exists()


@each_of(*UNTIDY, INJECTION, HUGE)
@pytest.mark.parametrize("place", TEXTS_OF_DBC, ids=("unit", "comment", "value", "other value", "other unit"))
def test_units_comments_and_values_of_a_dbc_are_text_in_a_proposal(place, name, tmp_path, says):
    dbc = tmp_path / "made.dbc"
    dbc.write_text(DBC.replace(place, quoted(f"{place[1:-1]} {name}")), encoding="utf-8")
    code, out, err = says("init", "--dbc", dbc)
    assert (code, err.count("\n")) == (0, 1)
    raw = tomllib.loads(out)
    assert set(raw) <= {"bus", "dbc", "vehicle", "axle", "wheel", "signals", "estimator"}
    assert raw["bus"] == {"interface": "socketcan", "channel": "can0"}
    used = {value if isinstance(value, str) else value["signal"] for value in raw["signals"].values()}
    assert used <= {"Motion.GroundSpeed", "Motion.PitchAngle", "?"}


@each_of(*UNTIDY, HUGE)
@pytest.mark.parametrize(
    "key",
    [
        "wheel.FL.name", "wheel.FL.torque", "wheel.FL.axle", "signals.draft", "signals.pitch.valid", "dbc.input",
        "dbc.checked", "output.dbc", "bus.channel", "bus.interface", "model.effects", "vehicle.towing", "table.torque",
    ],
)  # fmt: skip
def test_a_text_of_a_configuration_is_one_printable_line(key, name, tmp_path, says):
    value = [name] if key in ("dbc.input", "dbc.checked") else [{"name": name}] if key == "model.effects" else name
    text = tomlkit.item(value).as_string()
    code, _, err = says("check", "--config", "tractor", "--set", f"{key}={text}")
    assert code in (0, 1, 2)
    assert code == 0 or err.startswith("soilbus: ")


@each_of(*UNTIDY)
def test_beds_and_columns_of_a_test_rig_are_text(name, tmp_path, says):
    rig = Path(__file__).resolve().parents[2] / "service/docs/notebooks"
    with (rig / "rig.csv").open(newline="", encoding="utf-8") as file:
        head, *rows = list(csv.reader(file))
    document = tomlkit.parse((rig / "rig.toml").read_text())
    torque = document["table"]["torque"]
    column = torque if isinstance(torque, str) else torque["column"]
    document["table"]["torque"] = {
        "column": name.strip(),
        "factor": 1.0 if isinstance(torque, str) else torque["factor"],
    }
    document["table"]["run"] = "bed"
    config, table, out = tmp_path / "rig.toml", tmp_path / f"{name.replace('/', '_')}.csv", tmp_path / "w.jsonl"
    config.write_text(tomlkit.dumps(document), encoding="utf-8")
    with table.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow([*(name.strip() if each == column else each for each in head), "bed"])
        writer.writerows([*row, name if n % 2 else "plain"] for n, row in enumerate(rows))
    code, _, _ = says("check", "--config", config)
    assert code == 0
    code, _, err = says("replay", "--config", config, table, "--json", out, "--table", tmp_path / "w.csv")
    assert code in (0, 1), err
    for line in out.read_text().splitlines() if out.exists() else []:
        assert json.loads(line)["log"].isprintable()


@given(st.text(), st.integers(5, 300))
def test_a_text_is_shown_in_one_printable_line(text: str, most: int) -> None:
    line = shown(text, most)
    assert line.isprintable()
    assert len(line) <= most
    assert shown(line, most) == line
    assert line == text or not text.isprintable() or len(text) > most


TEXTS = st.text(st.characters(exclude_categories=["Cs"]), max_size=60)


@given(TEXTS, TEXTS)
def test_toml_holds_any_text_and_is_printable(value: str, comment: str) -> None:
    document = tomlkit.document()
    document.add(tomlkit.comment(shown(comment)))
    document.add("key", tomlkit.item({"inner": value}))
    text = toml_text(document)
    assert tomllib.loads(text) == {"key": {"inner": value}}
    assert all(line.isprintable() for line in text.split("\n"))


@given(st.lists(TEXTS, min_size=1, max_size=5))
def test_no_text_of_a_csv_is_a_formula(names: list[str]) -> None:
    out = io.StringIO(newline="")
    write_csv(out, [{"t": -1.5, "log": name} for name in names])
    head, *rows = csv.reader(io.StringIO(out.getvalue(), newline=""))
    assert head == ["t", "log"]
    assert len(rows) == len(names)
    for row, name in zip(rows, names, strict=True):
        assert row[0] == "-1.5"
        assert re.sub("^'(?=[=+@-]|\\\\[tr])", "", row[1]) == shown(name)
        assert not row[1].startswith(("=", "+", "-", "@", "\t", "\r"))
