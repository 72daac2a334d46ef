"""What the arguments of a batch name: manifests of all kinds, folders with anything in them, archives and servers."""

import os
import zipfile
from pathlib import Path
from urllib.parse import urlsplit

import pytest

import soilbus
from soilbus.config.file import load_config
from soilbus.offline.batch import run_batch
from soilbus.offline.cluster import BatchError
from soilbus.offline.jobs import jobs_of

pd = pytest.importorskip("pandas")
pytest.importorskip("distributed")


@pytest.fixture
def named(config, tmp_path, monkeypatch):
    """Vehicle, path and start of each log that an argument names; `a.log` and `T7/b.log` are there."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "T7").mkdir()
    for name in ("a.log", "T7/b.log"):
        (tmp_path / name).write_text("")

    def jobs(*arguments: str):
        found = jobs_of(config, "t", list(arguments), lambda path: config.model_copy(update={"folder": path.parent}))
        return [(job.vehicle, os.path.relpath(job.log, tmp_path), job.start) for job in found]

    return jobs


@pytest.mark.parametrize(
    "text",
    [
        "log,vehicle,start\na.log,V 1,60\n",
        "\ufefflog;vehicle;start;driver\r\na.log;V 1;60;Ann\r\n",
        "Log\tVehicle\tSTART\na.log\tV 1\t1970-01-01T02:01:00+02:00\n",
        "log, vehicle, start\n\na.log, V 1, 1970-01-01 00:01\n , ,\n",
        "log;vehicle;start;place, field, and remarks\na.log;V 1;60;\n",
    ],
)
def test_a_manifest_of_any_spreadsheet_is_read(text, named):
    Path("m.CSV").write_text(text, encoding="utf-8")
    assert named("m.CSV") == [("V 1", "a.log", 60.0)]


def test_a_day_of_eight_digits_is_a_day(named):
    Path("m.csv").write_text("log,start\na.log,20240501\n")
    assert named("m.csv")[0][2] == 1714521600.0


def test_cells_that_are_missing_are_not_their_text(named):
    pd.DataFrame({"log": ["a.log", "T7/b.log"], "vehicle": [7.0, None], "start": [60.0, None]}).to_parquet("m.pq")
    assert named("m.pq") == [("7", "a.log", 60.0), ("T7", "T7/b.log", None)]
    Path("m.csv").write_text("log,start\na.log,NaN\n")
    assert named("m.csv")[0][2] is None


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("log,vehicle\n", "no row in it"),
        ("# fleet\nlog,vehicle\na.log,T1\n", "needs a column log; its columns are # fleet"),
        ("log,vehicle\na.log,T1\n,T2\n", "row 3 has no log"),
        ("vehicle,log\nT1\nT2,a.log\n", "row 2 has no log"),
        ('log,vehicle\n"a.log,T1\n', "not a table that can be read"),
        ("log,start\na.log,inf\n", "start inf is neither"),
        ("log,vehicle\na.log," + "ü" * 50, "no name that a folder of results can have"),
        ("log,vehicle\na.log,__HIVE_DEFAULT_PARTITION__\n", "no name that a folder of results can have"),
    ],
)
def test_a_manifest_that_cannot_be_meant_is_one_line(text, line, named):
    Path("m.csv").write_text(text, encoding="utf-8")
    with pytest.raises(BatchError) as fault:
        named("m.csv")
    assert line in str(fault.value)


def test_a_manifest_may_name_a_reference_machine(config):
    asked: list[Path] = []

    def load(path: Path):
        asked.append(path)
        return config

    Path("m.csv").write_text("log,configuration\na.log,tractor-2wd\n")
    jobs_of(config, "t", ["m.csv"], load)
    assert asked == [Path("tractor-2wd")]


@pytest.fixture(autouse=True)
def _there(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


def test_links_keep_the_vehicle_of_the_folder_they_lie_in(named):
    Path("fleet/T9").mkdir(parents=True)
    Path("fleet/T9/c.log").symlink_to(Path("a.log").resolve())
    Path("fleet/T7").symlink_to(Path("T7").resolve())
    Path("fleet/T9/up").symlink_to("..")  # a circle
    Path("T7/other").symlink_to("../T8")
    Path("T8").mkdir()
    Path("T8/back").symlink_to("../T7")
    Path("fleet/latest").symlink_to("T9")
    Path("fleet/T9/e.log").write_text("")
    Path("fleet/T9/latest.log").symlink_to("e.log")
    wanted = [("T7", "fleet/T7/b.log", None), ("T9", "fleet/T9/c.log", None), ("T9", "fleet/T9/e.log", None)]
    assert named("fleet") == named("fl*") == wanted


def test_what_is_no_file_or_cannot_be_read_is_an_error_of_its_own(client, config, named, monkeypatch):
    Path("fleet/T7/x.log").mkdir(parents=True)
    Path("fleet/T7/null.log").symlink_to("/dev/null")
    Path("fleet/T7/gone.log").symlink_to("nowhere")
    Path("fleet/closed").mkdir()
    scandir, access = os.scandir, os.access
    closed = os.path.abspath("fleet/closed")

    def refused(place):
        if str(place) == closed:
            raise PermissionError(13, "Permission denied", place)
        return scandir(place)

    monkeypatch.setattr("os.scandir", refused)
    monkeypatch.setattr("os.access", lambda place, *how, **more: str(place) != closed and access(place, *how, **more))
    errors = run_batch(client, jobs_of(config, "t", ["fleet"], lambda _: config), Path("out")).errors
    assert {os.path.relpath(row["log"]): row["fault"].rpartition(": ")[2] for row in errors} == {
        "fleet/T7/x.log": "a folder",
        "fleet/T7/null.log": "not a regular file",
        "fleet/T7/gone.log": "no such file",
        "fleet/closed": "a folder that cannot be read",
    }


def test_a_log_in_an_archive_is_that_log(client, config, moved, named):
    with zipfile.ZipFile("fleet.zip", "w") as archive:
        archive.writestr("T7/a.log", moved(0.0))
        archive.writestr("T7/readme.txt", "no log")
    archive = f"::file://{os.path.abspath('fleet.zip')}"
    for argument in (f"zip://T7/a.log{archive}", f"zip://T7{archive}", f"zip://*/a.l?g{archive}"):
        (job,) = jobs_of(config, "t", [argument], lambda _: config)
        assert (job.vehicle, job.log) == ("T7", f"zip://T7/a.log{archive}")
    batch = run_batch(client, [job], Path("out"))
    assert (batch.windows, batch.errors) == (5, [])


@pytest.mark.parametrize("written", ["to_csv", "to_parquet"])
def test_a_manifest_by_url_names_logs_from_its_own_folder(written, config, named, tmp_path):
    table = pd.DataFrame({"log": ["T7/b.log", "file:///elsewhere/c.log"], "vehicle": ["V 1", "V 2"], "start": [60, 70]})
    name = f"m.{written.removeprefix('to_')}"
    getattr(table, written)(name, index=False)
    found = jobs_of(config, "t", [f"file://{tmp_path}/{name}"], lambda _: config)
    assert [(job.vehicle, job.log, job.start) for job in found] == [
        ("V 1", f"file://{tmp_path}/T7/b.log", 60.0),
        ("V 2", "file:///elsewhere/c.log", 70.0),
    ]


def test_a_configuration_in_a_manifest_by_url_must_be_one_that_is_here(config, named, tmp_path):
    Path("m.csv").write_text("log,configuration\na.log,mine.toml\n")
    with pytest.raises(
        BatchError, match=r"row 2: configuration mine\.toml: .* reference machine's name or an absolute"
    ):
        jobs_of(config, "t", [f"file://{tmp_path}/m.csv"], lambda _: config)


def test_a_table_by_url_that_is_not_there_or_no_manifest_is_a_log(config, named, tmp_path):
    Path("can.csv").write_text("timestamp,arbitration_id,extended,remote,error,dlc,data\n")
    for name in ("none.csv", "can.csv"):
        (job,) = jobs_of(config, "t", [f"file://{tmp_path}/{name}"], lambda _: config)
        assert job.log == f"file://{tmp_path}/{name}"


def test_a_query_is_no_part_of_a_logs_name(config):
    url = "https://store.example/T7/a.log.gz?token=a/b*"
    (job,) = jobs_of(config, "t", [url], lambda _: config)
    assert (job.vehicle, job.log, urlsplit(job.log).query) == ("T7", url, "token=a/b*")


def test_tables_of_a_test_rig_are_logs(client, tmp_path):
    notebooks = Path(soilbus.__file__).parents[1] / "docs/notebooks"
    config = load_config(notebooks / "rig.toml")
    Path("m.csv").write_text(f"log,vehicle\n{notebooks / 'rig.csv'},bench\n")
    assert [job.vehicle for job in jobs_of(config, "t", [str(notebooks / "rig.csv")], lambda _: config)] == [
        "notebooks"
    ]
    run_batch(client, jobs_of(config, "t", ["m.csv"], lambda _: config), Path("out"))
    windows = pd.read_parquet("out/windows").set_index("log")
    assert set(windows.index) == {f"{notebooks}/rig.csv, {bed}" for bed in ("loose", "compacted")}
    assert (windows["soil.k_phi.value"] > 0).all()
