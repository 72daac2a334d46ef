"""A batch: every log is done or named, what was done stays done, and other programs read the results."""

import json
import shutil
from pathlib import Path

import fsspec
import pytest

import soilbus
from soilbus.can.dbc_files import load_databases
from soilbus.cli.main import main
from soilbus.config.model import ConfigError
from soilbus.offline.batch import run_batch
from soilbus.offline.cluster import BatchError
from soilbus.offline.jobs import jobs_of
from soilbus.offline.replay import replay
from soilbus.pipeline.outputs import flat_record, json_line
from soilbus.pipeline.pipeline import Pipeline
from soilbus.report.batch import batch_text, fleet_text
from soilbus.terra.effects.catalogue import CATALOGUE

pd = pytest.importorskip("pandas")
SHORT = "estimator.window=4"


def no_other(path: Path):
    raise AssertionError(f"nobody asked for {path}")


def files(out: Path) -> dict[str, bytes]:
    return {str(path.relative_to(out)): path.read_bytes() for path in out.rglob("*") if path.is_file()}


@pytest.fixture(scope="module")
def jobs(config, logs):
    return jobs_of(config, "tractor.toml", [str(logs)], no_other)


@pytest.fixture(scope="module")
def done(client, jobs, tmp_path_factory):
    out = tmp_path_factory.mktemp("out") / "fleet"
    return run_batch(client, jobs, out), out


def test_the_windows_are_those_of_replay(done, config, logs):
    _, out = done
    windows = pd.read_parquet(out / "windows")
    log = logs / "red/morning.log"
    wanted = [
        flat_record(json.loads(json_line(result, config)))
        for result in replay(Pipeline(config, load_databases(config)), [log])
    ]
    got = windows[windows.log == str(log)].sort_values("t").to_dict("records")
    assert len(got) == len(wanted) == 5
    for row, want in zip(got, wanted, strict=True):
        for name, value in want.items():
            if name != "log" and value is not None:
                assert row[name] == value, name


def test_a_broken_log_is_a_line_and_takes_nothing_with_it(done, logs):
    batch, out = done
    errors = pd.read_parquet(out / "errors.parquet").set_index("log")
    assert set(errors.index) == {str(logs / "blue" / name) for name in ("cut.log", "garbage.log", "other.log")}
    assert "not a CAN log" in errors.fault[str(logs / "blue/garbage.log")]
    assert "none of its 29 frames is in the DBC" in errors.fault[str(logs / "blue/other.log")]
    cut = errors.loc[str(logs / "blue/cut.log")]
    assert "cut off" in cut.fault
    windows = pd.read_parquet(out / "windows")
    assert cut.windows == (windows.log == str(logs / "blue/cut.log")).sum() == 4
    assert not errors.fault.str.contains("\n").any()
    text = batch_text(batch, out)
    assert "4 of 6 logs done" in text
    assert "(the 4 windows before that are kept)" in text


def test_a_log_across_midnight_lies_in_two_days(done, logs):
    windows = pd.read_parquet(done[1] / "windows", filters=[("vehicle", "==", "red")])
    of_days = windows[windows.log == str(logs / "red/midnight.log")].groupby("day", observed=True)
    assert {str(day): len(rows) for day, rows in of_days} == {"2023-11-14": 2, "2023-11-15": 3}
    ends = windows.time.dt.strftime("%Y-%m-%d").astype(str)
    assert (ends == windows.day.astype(str)).all()


def test_duckdb_and_geopandas_read_the_same(done):
    duckdb, geopandas = pytest.importorskip("duckdb"), pytest.importorskip("geopandas")
    out = done[1]
    windows = pd.read_parquet(out / "windows")
    found = duckdb.sql(
        f"select vehicle, count(*), avg(\"bearing_pressure.value\") from read_parquet('{out}/windows/**/*.parquet',"
        " hive_partitioning = true) group by vehicle order by vehicle"
    ).fetchall()
    means = windows.groupby("vehicle", observed=True)["bearing_pressure.value"]
    assert [(v, n) for v, n, _ in found] == [(str(v), n) for v, n in means.size().items()] == [("blue", 9), ("red", 10)]
    assert [mean for *_, mean in found] == pytest.approx(list(means.mean()))
    points = geopandas.read_parquet(out / "map.parquet")
    assert len(points) == windows.longitude.notna().sum() == 19
    assert points.crs == "OGC:CRS84"
    assert points.geometry.x.sum() == pytest.approx(windows.longitude.sum())
    assert points.geometry.y.sum() == pytest.approx(windows.latitude.sum())


def test_the_tables_carry_units_and_versions(done):
    import pyarrow.parquet as pq

    schemas = [pq.read_schema(path) for path in (done[1] / "windows").rglob("*.parquet")]
    assert len({tuple(schema.names) for schema in schemas}) == 1
    for schema in (*schemas, *(pq.read_schema(done[1] / f"{n}.parquet") for n in ("logs", "vehicles", "map"))):
        assert schema.metadata[b"soilbus_version"] == soilbus.__version__.encode()
        assert schema.metadata[b"soilbus_schema"]
    assert schemas[0].field("soil.k_phi.value").metadata == {b"unit": b"N/m^(n+2)"}


def test_the_summaries_count_what_the_windows_hold(done):
    out = done[1]
    windows, logs = pd.read_parquet(out / "windows"), pd.read_parquet(out / "logs.parquet").set_index("log")
    vehicles = pd.read_parquet(out / "vehicles.parquet").set_index("vehicle")
    for log, rows in windows.groupby("log"):
        valid = rows[rows.status == "valid"]
        assert logs["windows.all"][log] == len(rows)
        assert logs["windows.valid"][log] == len(valid)
        assert logs["bearing_pressure.mean"][log] == pytest.approx(valid["bearing_pressure.value"].mean())
        assert logs.end[log] == rows.time.max()
        assert logs.duration[log] == len(rows) + 3.0  # hops of 1 s, and the first window of 4 s
    assert vehicles["logs.failed"].to_dict() == {"blue": 2, "red": 0}
    assert vehicles["logs.damaged"].to_dict() == {"blue": 1, "red": 0}
    assert vehicles["windows.all"].sum() == len(windows)
    assert (vehicles["frames.mapped"] > 0).all()
    counts = [name for name in logs.columns if name.startswith("rejected.")]
    assert vehicles[counts].sum().to_dict() == logs[counts].sum().to_dict()


def test_a_stopped_batch_goes_on_to_the_same_bytes(client, jobs, done, tmp_path):
    def stop(what: str) -> None:
        if what.startswith("3 of"):
            raise KeyboardInterrupt

    out = tmp_path / "fleet"
    with pytest.raises(KeyboardInterrupt):
        run_batch(client, jobs, out, stop)
    before = list((out / "parts").glob("*.parquet"))
    assert 0 < len(before) < 4
    run_batch(client, jobs, out)
    assert files(out) == files(done[1])
    batch = run_batch(client, jobs, out)
    assert (batch.resumed, batch.failed_before) == (6, 3)
    assert files(out) == files(done[1])
    before[0].write_bytes(b"half a part")
    assert run_batch(client, jobs, out).windows == batch.windows
    assert files(out) == files(done[1])


def test_a_good_log_that_changed_is_read_again(client, config, moved, tmp_path):
    changed, same, url = tmp_path / "red/a.log", tmp_path / "red/b.log", "memory://changed/c.log"
    changed.parent.mkdir()
    same.write_text(moved(20.0))

    def write(text: str, longer: str) -> None:
        changed.write_text(text)
        with fsspec.open(url, "w") as file:
            file.write(longer)

    write(moved(0.0), moved(0.0))
    own, out = jobs_of(config, "t", [str(changed), str(same), url], no_other), tmp_path / "out"
    run_batch(client, own, out)
    write(moved(400.0), moved(400.0) + "(1700000500.0) can0 7AB#0102\n")  # the file as large as before, the URL's not
    assert run_batch(client, own, out).resumed == 1
    run_batch(client, own, tmp_path / "new")
    assert files(out) == files(tmp_path / "new")
    times = pd.read_parquet(out / "windows").groupby("log").time.min()
    assert (times[url] - times[str(same)]).total_seconds() == pytest.approx(380.0)
    write("no log at all\n", "no log at all\n")
    batch = run_batch(client, own, out)
    assert (batch.resumed, batch.windows, len(batch.errors)) == (1, 5, 2)


def test_a_fault_is_kept_until_its_file_changes_or_on_request(client, config, logs, tmp_path):
    for name in ("cut.log", "garbage.log", "other.log"):
        shutil.copy(logs / "blue" / name, tmp_path)
    garbage = (str(tmp_path / "garbage.log"), "memory://faults/garbage.log")
    with fsspec.open(garbage[1], "wb") as file:
        file.write(b"no log at all\n")
    own, out = jobs_of(config, "t", [str(tmp_path / "*.log"), garbage[1]], no_other), tmp_path / "out"
    assert run_batch(client, own, out).resumed == 0
    errors = (out / "errors.parquet").read_bytes()
    again = run_batch(client, own, out)
    assert (again.resumed, again.failed_before) == (4, 4)
    assert (out / "errors.parquet").read_bytes() == errors
    assert run_batch(client, own, out, retry=True).resumed == 0
    assert (out / "errors.parquet").read_bytes() == errors
    for each in garbage:
        with fsspec.open(each, "ab") as file:
            file.write(b"no log, and longer than before\n")
    assert run_batch(client, own, out).resumed == 2


def test_what_is_no_fault_of_the_log_is_tried_again(client, config, logs, moved, tmp_path, monkeypatch):
    whole, missing = tmp_path / "a/whole.log", tmp_path / "a/missing.log"
    whole.parent.mkdir()
    whole.write_text(moved(0.0))
    own, out = jobs_of(config, "t", [str(whole), str(missing)], no_other), tmp_path / "out"
    with monkeypatch.context() as patch:
        patch.setattr("soilbus.offline.batch.part_of", die)
        faults = [row["fault"] for row in run_batch(client, own, out).errors]
    assert all("its worker died each time" in fault for fault in faults)
    batch = run_batch(client, own, out)
    assert (batch.resumed, batch.windows) == (0, 5)
    assert [row["fault"] for row in batch.errors] == [f"{missing}: no such file"]
    missing.write_text(moved(20.0))
    assert run_batch(client, own, out).windows == 10


class KilledWorker(Exception):
    """By the name of Dask's."""


def die(job: object, *_: object) -> None:
    raise KilledWorker(job)


@pytest.fixture
def one_candidate(monkeypatch):
    """Diagnoses try one effect alone."""
    monkeypatch.setattr("soilbus.offline.fleet.possible_effects", lambda config: [CATALOGUE["grade"]])


@pytest.mark.usefixtures("one_candidate")
def test_a_vehicle_whose_diagnosis_failed_is_diagnosed_again_on_request(client, config, logs, tmp_path, monkeypatch):
    own = jobs_of(config, "t", [str(logs / "red")], no_other)
    with monkeypatch.context() as patch:
        patch.setattr("soilbus.offline.batch.findings_of", die)
        run_batch(client, own, tmp_path, diagnose=True)
    said: dict[bool, list[str]] = {False: [], True: []}
    for retry, lines in said.items():
        run_batch(client, own, tmp_path, lines.append, diagnose=True, retry=retry)
    assert ["1 of 1 vehicles diagnosed" in lines for lines in said.values()] == [False, True]


@pytest.mark.usefixtures("one_candidate")
def test_a_diagnosis_of_an_earlier_run_does_not_stay_beside_other_logs(client, config, logs, moved, tmp_path):
    (tmp_path / "logs/red").mkdir(parents=True)
    (tmp_path / "logs/red/a.log").write_text(moved(0.0))
    out, command = tmp_path / "out", [str(tmp_path / "logs")]
    run_batch(client, jobs_of(config, "t", command, lambda _: config), out, diagnose=True)
    assert (out / "diagnosis.json").is_file()
    (tmp_path / "logs/red/b.log").write_text(moved(60.0))
    batch = run_batch(client, jobs_of(config, "t", command, lambda _: config), out)
    assert not (out / "diagnosis.json").exists()
    assert not (out / "effects.parquet").exists()
    assert "of an earlier run are removed; --diagnose writes them again" in batch_text(batch, out)
    again = run_batch(client, jobs_of(config, "t", command, lambda _: config), out)
    assert "of an earlier run" not in batch_text(again, out)


def test_a_parameter_at_the_edge_of_its_range_has_no_deviation_of_zero():
    sizes = {"softening": {"value": 0.4, "std": 0.03}, "dug": {"value": 0.0, "std": 0.0}}
    effect = {"name": "slip_sinkage", "parameters": sizes, "named": True, "onset": None}
    vehicle = {"vehicle": "T1", "effects": [effect], "logs": ["a.log"], "fault": None}
    text = fleet_text({"vehicles_diagnosed": 1, "vehicles": [vehicle], "false_discovery_rate": 0.1})
    assert "T1: slip_sinkage (softening 0.4 ± 0.03, dug 0 (at the edge of its range))" in text


def test_a_manifest_names_vehicle_start_and_configuration(client, config, logs, drive, tmp_path):
    since_begin = "".join(f"({float(line[1:18]) - 1.7e9 + 5.0:.6f}){line.split(')', 1)[1]}" for line in drive)
    (tmp_path / "a.log").write_text(since_begin)
    (tmp_path / "b.log").write_text(since_begin)
    (tmp_path / "other.toml").write_text("")
    manifest = tmp_path / "manifest.csv"
    manifest.write_text("log,vehicle,configuration,start\na.log,T 1/2,,2025-06-01T08:00:00Z\nb.log,T3,other.toml,\n")
    asked: list[Path] = []

    def load(path: Path):
        asked.append(path)
        return config

    own = jobs_of(config, "t", [str(manifest)], load)
    assert asked == [tmp_path / "other.toml"]
    batch = run_batch(client, own, tmp_path / "out")
    assert [row["vehicle"] for row in batch.vehicles] == ["T 1/2", "T3"]
    windows = pd.read_parquet(tmp_path / "out/windows").set_index("vehicle")
    assert set(windows.loc["T 1/2"].day.astype(str)) == {"2025-06-01"}
    assert windows.loc["T 1/2"].time.iloc[0] == pd.Timestamp("2025-06-01T08:00:04Z")
    assert windows.loc["T3"].time.isna().all()  # stamps that are no dates make no date
    assert set(windows.loc["T3"].day.astype(str)) == {"unknown"}


def test_logs_come_by_glob_url_and_parquet_manifest(config, logs, tmp_path):
    pd.DataFrame({"log": [str(logs / "red/morning.log")], "vehicle": ["x"]}).to_parquet(tmp_path / "m.parquet")
    names = [str(logs / "r*" / "*.log"), f"file://{logs}/blue/w*.log", str(tmp_path / "m.parquet")]
    found = [(job.vehicle, Path(job.log).name) for job in jobs_of(config, "t", names, no_other)]
    assert found == [("blue", "whole.log"), ("red", "midnight.log"), ("red", "morning.log"), ("x", "morning.log")]


def test_a_configuration_that_fits_no_log_is_one_line(client, config, logs, tmp_path):
    own = jobs_of(config, "mine.toml", [str(logs / "blue/other.log")], no_other)
    with pytest.raises(ConfigError) as fault:
        run_batch(client, own, tmp_path / "out")
    assert "mine.toml: fits no log" in str(fault.value)


def test_a_lost_scheduler_is_one_line_and_leaves_what_is_done(in_process, config, logs, tmp_path):
    own = jobs_of(config, "t", [str(logs / "red"), str(logs / "blue")], no_other)
    with in_process() as (local, client):

        def lose(_: str) -> None:
            local.sync(local.scheduler.close)

        with pytest.raises(BatchError, match="scheduler is lost; --resume"):
            run_batch(client, own, tmp_path / "out", lose)
    assert len(list((tmp_path / "out/parts").iterdir())) >= 1


@pytest.mark.parametrize("address", ["tcp://127.0.0.1:9", "nonsense", "tls://127.0.0.1:9"])
def test_a_scheduler_that_is_not_there_is_one_line(address, tractor, logs, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("soilbus.offline.cluster.CONNECT_TIMEOUT", 0.3)
    arguments = ["--out", str(tmp_path / "o"), "--scheduler", address]
    assert main(["batch", "--config", tractor, str(logs), *arguments]) == 1
    (said,) = capsys.readouterr().err.splitlines()
    assert f"{address}: no Dask scheduler there" in said


def test_workers_of_another_version_are_one_line(client, tractor, logs, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("soilbus.offline.cluster.worker_version", lambda: "0.0.9")
    arguments = ["--out", str(tmp_path / "o"), "--scheduler", client.scheduler.address]
    assert main(["batch", "--config", tractor, str(logs), *arguments]) == 1
    assert f"workers have soilbus 0.0.9, this is {soilbus.__version__}" in capsys.readouterr().err


@pytest.mark.parametrize(("missing", "line"), [("soilbus", "no soilbus"), ("soilbus.offline", "another soilbus")])
def test_workers_without_this_soilbus_are_one_line(missing, line, client, tractor, logs, tmp_path, capsys, monkeypatch):
    def run(*_: object) -> dict[str, str]:
        raise RuntimeError(f"ModuleNotFoundError(\"No module named '{missing}'\")")  # as Dask says it

    monkeypatch.setattr("distributed.Client.run", run)
    arguments = ["--out", str(tmp_path / "o"), "--scheduler", client.scheduler.address]
    assert main(["batch", "--config", tractor, str(logs), *arguments]) == 1
    (said,) = capsys.readouterr().err.splitlines()
    assert f"its workers have {line}" in said
    assert "install" in said


def test_results_are_not_overwritten_by_accident(client, done, tractor, logs, capsys):
    out, address = str(done[1]), client.scheduler.address
    assert main(["batch", "--config", tractor, str(logs), "--out", out, "--scheduler", address]) == 2
    assert "go on with --resume" in capsys.readouterr().err


def test_the_command_says_one_table(client, tractor, logs, tmp_path, capsys):
    options = ["--out", str(tmp_path / "o"), "--scheduler", client.scheduler.address, "--set", SHORT]
    assert main(["batch", "--config", tractor, str(logs / "red"), *options]) == 0
    printed = capsys.readouterr().out.splitlines()
    assert printed[0].split()[:2] == ["vehicle", "logs"]
    assert printed[2].split()[:2] == ["red", "2"]
    assert main(["batch", "--config", tractor, str(logs / "blue/garbage.log"), *options, "--resume"]) == 1
    assert "no log gave a window" in capsys.readouterr().err
