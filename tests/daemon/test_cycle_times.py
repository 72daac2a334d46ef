"""Readers judge silence by the DBC's cycle times: soilbus sends no frame less often than its DBC promises."""

import re
from collections.abc import Callable
from pathlib import Path

import pytest

from soilbus.can.dbc_files import output_database
from soilbus.can.publish import Publisher
from soilbus.cli.main import main
from soilbus.config.file import shipped_dbc
from soilbus.config.model import Config, ConfigError
from soilbus.decision.traversability import Status, Traversability
from soilbus.decision.watch import Watch
from soilbus.pipeline.outputs import FAST_FRAMES, HOP_FRAMES, forecast_frame, hop_frames, slip_frames
from soilbus.pipeline.result import WindowResult
from soilbus.simulator.reference import TRACTOR, reference_configuration


def test_a_dbc_that_tells_the_longer_hop_is_accepted_and_one_with_too_fast_fast_frames_is_not(tmp_path):
    text = shipped_dbc("soilbus.dbc").read_text(encoding="utf-8")
    toml = (tmp_path / "tractor.toml", TRACTOR.read_text(encoding="utf-8"))
    toml[0].write_text(toml[1] + '\n[output]\ndbc = "ours.dbc"\n[estimator]\nhop = 2.0\n', encoding="utf-8")
    (tmp_path / "ours.dbc").write_text(text.replace(" 1000;", " 2000;"), encoding="utf-8")
    assert main(["check", "--config", str(toml[0])]) == 0
    (tmp_path / "ours.dbc").write_text(text.replace(" 1000;", " 2000;").replace(" 100;", " 20;"), encoding="utf-8")
    assert main(["check", "--config", str(toml[0])]) == 2


def test_run_and_check_say_it_in_one_line(capsys):
    for command in ("check", "run"):
        assert main([command, "--config", str(TRACTOR), "--set", "estimator.hop=5"]) == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert "GenMsgCycleTime" in line


def test_the_frames_of_each_cycle_are_all_that_there_are():
    nothing = WindowResult(
        t=0.0, index=0, status=Status.INVALID, reason="none", posterior=None, bearing=None,
        slip=dict.fromkeys("abcdef"), sinkage=dict.fromkeys("abcdef"), traversability=Traversability(), chi2=None,
        samples=0, rejected={},
    )  # fmt: skip
    assert {message for message, _ in hop_frames(nothing)} == set(HOP_FRAMES)
    fast = [*slip_frames(nothing.slip), forecast_frame(None, Watch())]
    assert {message for message, _ in fast} < set(FAST_FRAMES)
    everything = {message.name for message in output_database(reference_configuration()).messages}
    assert everything == {*HOP_FRAMES, *FAST_FRAMES, "SoilbusStatus", "SoilbusIdentity", "BusHealth"}


VEHICLES = """
BO_ 300 Vehicle: 8 SOILBUS
 SG_ Page M : 0|8@1+ (1,0) [0|0] "" DASHBOARD
 SG_ Float m1 : 8|8@1+ (1,0) [0|0] "" DASHBOARD

CM_ """


def edited(tmp_path: Path, change: Callable[[str], str]) -> Config:
    text = shipped_dbc("soilbus.dbc").read_text(encoding="utf-8")
    (tmp_path / "edited.dbc").write_text(change(text), encoding="utf-8")
    return reference_configuration([f'output.dbc="{tmp_path / "edited.dbc"}"'])


def test_ours_among_the_vehicles_own_messages_are_all_that_is_sent(tmp_path):
    config = edited(tmp_path, lambda text: text.replace("\nCM_ ", VEHICLES, 1))
    plain = output_database(reference_configuration())
    assert {m.name for m in output_database(config).messages} == {m.name for m in plain.messages}
    for message in plain.messages:
        assert Publisher(output_database(config)).frame(message.name, {}) == Publisher(plain).frame(message.name, {})


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        (r'BA_ "GenMsgCycleTime" BO_ 2566873242 .*', "", "SoilbusStatus: no cycle time"),
        (r"SG_ Age : 24\|8", "SG_ Age : 24|4", "Traversability.Age: .* does not fit into 4 bits"),
        (r"(VAL_ \d+ Warning .*)\"unknown\"", r'\1"open"', "no code for unknown in the value table of DemandForecast"),
        (r"\bSinceValid\b", "Since", "no signal Traversability.SinceValid"),
    ],
)
def test_an_edited_dbc_that_cannot_carry_our_frames_is_refused_before_the_start(old, new, said, tmp_path):
    config = edited(tmp_path, lambda text: re.sub(old, new, text))
    with pytest.raises(ConfigError) as error:
        output_database(config)
    assert all(fault.startswith("output.dbc: ") for fault in error.value.faults)
    assert any(re.search(said, fault) for fault in error.value.faults)
