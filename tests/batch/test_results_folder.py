"""The folder of results: one batch at a time, nobody else's files, nothing of earlier arguments left in it."""

import logging
import shutil

import pytest

from soilbus.cli.main import main
from soilbus.offline.batch import results_in, run_batch
from soilbus.offline.cluster import BatchError, cluster
from soilbus.offline.jobs import jobs_of
from soilbus.offline.parts import Job, part_of, setup_of

pytest.importorskip("distributed")


def test_a_second_batch_into_the_same_folder_is_refused(tmp_path):
    out = tmp_path / "out"
    with results_in(out), pytest.raises(BatchError, match="another soilbus batch"), results_in(out):
        pass
    with results_in(out):
        pass


@pytest.mark.parametrize("resume", [[], ["--resume"]])
def test_files_of_others_are_not_replaced(resume, tractor, logs, tmp_path, capsys):
    (tmp_path / "windows").mkdir()
    (tmp_path / "windows/house.txt").write_text("south side")
    assert main(["batch", "--config", tractor, str(logs), "--out", str(tmp_path), *resume]) == 2
    assert "windows, which would be replaced" in capsys.readouterr().err
    assert (tmp_path / "windows/house.txt").read_text() == "south side"


def test_a_file_in_place_of_the_folder_is_one_line(tractor, logs, tmp_path, capsys):
    (tmp_path / "out").write_text("")
    assert main(["batch", "--config", tractor, str(logs), "--out", str(tmp_path / "out")]) == 2
    assert capsys.readouterr().err == f"soilbus: --out {tmp_path}/out: a file, no folder\n"


def test_results_are_those_of_the_logs_of_the_last_run(client, config, logs, tmp_path):
    run_batch(client, jobs_of(config, "t", [str(logs / "red/morning.log")], lambda _: config), tmp_path)
    run_batch(client, jobs_of(config, "t", [str(logs / "blue/garbage.log")], lambda _: config), tmp_path)
    assert {each.name for each in tmp_path.iterdir()} == {"parts", "errors.parquet", "vehicles.parquet"}


def test_a_batch_that_is_interrupted_says_how_to_go_on(client, tractor, logs, tmp_path, capsys, monkeypatch):
    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("soilbus.offline.batch.run_batch", interrupted)
    address = ["--scheduler", client.scheduler.address]
    assert main(["batch", "--config", tractor, str(logs / "red"), "--out", str(tmp_path / "o"), *address]) == 130
    assert capsys.readouterr().err.splitlines()[-1] == "soilbus: stopped; --resume goes on from here"


def test_dask_prints_nothing_of_a_lost_scheduler(client):
    with cluster(client.scheduler.address):
        pass
    names = [name for name in logging.root.manager.loggerDict if name.startswith("distributed")]
    assert [name for name in names if logging.getLogger(name).isEnabledFor(logging.ERROR)] == []


def test_a_format_that_a_worker_lacks_is_no_fault_of_the_log(config, tmp_path, monkeypatch):
    (tmp_path / "a.mf4").write_bytes(b"MDF     4.10")
    monkeypatch.setattr("can.io.mf4.asammdf", None)
    outcome, _ = part_of(Job(str(tmp_path / "a.mf4"), "T7", setup_of(config, "t")))
    assert (outcome.fault, outcome.lasting) == (f"{tmp_path}/a.mf4: this format needs soilbus[mf4]", False)


def test_a_log_that_takes_more_processor_time_than_its_size_allows_is_given_up(config, moved, tmp_path, monkeypatch):
    log = tmp_path / "a.log"
    log.write_text(moved(0.0))
    job = Job(str(log), "T7", setup_of(config, "t"))
    assert part_of(job)[0].fault is None
    monkeypatch.setattr("soilbus.offline.parts.CPU_FREE", 0.0)
    monkeypatch.setattr("soilbus.offline.parts.CPU_PER_BYTE", 0.0)
    outcome, _ = part_of(job)
    assert outcome.fault == f"{log}: given up: it takes more processor time than a log of its size may"
    assert outcome.lasting


def test_a_log_that_left_its_folder_keeps_its_windows(client, config, moved, tmp_path):
    logs, out = tmp_path / "fleet/T7", tmp_path / "out"
    logs.mkdir(parents=True)
    for n in range(2):
        (logs / f"{n}.log").write_text(moved(100.0 * n))

    def batch(*arguments: object, **other: object):
        of = config.model_copy(update=other)
        return run_batch(client, jobs_of(of, "t", [str(each) for each in arguments], lambda _: of, out / "parts"), out)

    assert batch(logs.parent).windows == 10
    (logs / "0.log").unlink()
    whole = (out / "logs.parquet").read_bytes()
    for arguments in ([logs.parent], [logs], [f"{logs.parent}/*/*.log"], [f"{logs.parent}/T*"]):
        again = batch(*arguments)
        assert (again.windows, again.errors, again.resumed) == (10, [], 2)
        assert (out / "logs.parquet").read_bytes() == whole
    assert batch(logs / "1.log").windows == 5
    (logs / "1.log").unlink()
    assert batch(logs).windows == 10
    with pytest.raises(BatchError, match="no log there"):
        batch(logs, output=config.output.model_copy(update={"dbc": "other.dbc"}))


def test_the_configuration_of_the_current_folder_is_taken(client, tractor, logs, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    shutil.copy(tractor, "soilbus.toml")
    arguments = ["--set", "estimator.window=4", "--out", "o", "--scheduler", client.scheduler.address]
    assert main(["batch", str(logs / "red/morning.log"), *arguments]) == 0
    assert "1 of 1 logs done" in capsys.readouterr().out


def test_a_part_that_cannot_be_read_is_one_line(client, config, logs, tmp_path):
    own = jobs_of(config, "t", [str(logs / "red/morning.log")], lambda _: config)
    run_batch(client, own, tmp_path)
    (part,) = (tmp_path / "parts").glob("*.parquet")
    part.write_bytes(bytes(part.stat().st_size))
    with pytest.raises(BatchError, match="the parts cannot be made into tables"):
        run_batch(client, own, tmp_path)
