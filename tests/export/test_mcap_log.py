"""The MCAP log of a drive: read back by the mcap library, its messages held against their own schemas."""

import gzip
import json
import math
from collections import defaultdict
from dataclasses import replace
from pathlib import Path

import jsonschema
import pytest
from mcap.reader import make_reader

from soilbus.can.dbc_files import load_databases
from soilbus.export.mcap_log import write_mcap
from soilbus.offline.replay import read_frames, replay
from soilbus.pipeline.outputs import json_line
from soilbus.pipeline.pipeline import Pipeline

TYPES = {"object", "array", "string", "number", "integer", "boolean"}


@pytest.fixture(scope="module")
def mcap(windows, config, log, tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("mcap") / "drive.mcap"
    write_mcap(path, windows, config, [("can0", frame) for frame in read_frames(log)])
    return path


@pytest.fixture(scope="module")
def topics(mcap) -> dict[str, list]:
    found = defaultdict(list)
    validators = {}
    with mcap.open("rb") as file:
        for schema, channel, message in make_reader(file, validate_crcs=True).iter_messages():
            assert (schema.encoding, channel.message_encoding) == ("jsonschema", "json")
            if schema.id not in validators:
                validators[schema.id] = jsonschema.Draft202012Validator(json.loads(schema.data))
                validators[schema.id].check_schema(json.loads(schema.data))
            content = json.loads(message.data, parse_constant=pytest.fail)
            validators[schema.id].validate(content)
            found[channel.topic].append((schema, message, content))
    return found


def without_unknowns(value):
    return {k: without_unknowns(v) for k, v in value.items() if v is not None} if isinstance(value, dict) else value


def test_windows_are_the_json_lines_without_what_is_not_known(topics, windows, config):
    expected = [without_unknowns(json.loads(json_line(window, config))) for window in windows]
    assert [content for _, _, content in topics["/soilbus/window"]] == expected
    for (_, message, _), window in zip(topics["/soilbus/window"], windows, strict=True):
        assert message.log_time == pytest.approx(window.t * 1e9, abs=200)


def test_a_schema_is_what_foxglove_reads(topics):
    """One plain type for each field, properties for each object: its parser refuses anything else."""

    def check(schema: dict, path: str) -> None:
        assert schema["type"] in TYPES, path
        for key, inner in schema["properties"].items() if schema["type"] == "object" else ():
            check(inner, f"{path}.{key}")
        if schema["type"] == "array":
            check(schema["items"], f"{path}[]")

    for found in topics.values():
        check(json.loads(found[0][0].data), "")


def test_units_stand_in_the_descriptions(topics):
    schema = json.loads(topics["/soilbus/window"][0][0].data)["properties"]
    assert schema["bearing_pressure"]["properties"]["value"]["description"] == "Pa"
    assert schema["capability"]["properties"]["over_slip"]["properties"]["torque"]["items"]["description"] == "N m"


def test_locations_are_foxgloves_and_where_the_windows_are(topics, windows):
    assert {schema.name for schema, _, _ in topics["/soilbus/location"]} == {"foxglove.LocationFix"}
    for (_, message, fix), window in zip(topics["/soilbus/location"], windows, strict=True):
        assert math.radians(fix["latitude"]) == pytest.approx(window.position.latitude, abs=1e-12)
        assert math.radians(fix["longitude"]) == pytest.approx(window.position.longitude, abs=1e-12)
        assert fix["timestamp"]["sec"] * 10**9 + fix["timestamp"]["nsec"] == message.log_time


def test_a_warning_stands_where_it_began(topics, windows):
    ((schema, message, content),) = topics["/soilbus/warning"]
    assert schema.name == "foxglove.Log"
    assert message.log_time == pytest.approx(windows[-1].warnings.begun[0] * 1e9, abs=200)
    assert "immobilisation" in content["message"]


def test_frames_are_those_of_the_log(topics, log):
    ((_, channel),) = {(schema.name, content["header"]["frame_id"]) for schema, _, content in topics["/can"]}
    assert channel == "can0"
    said = [(content["id"], bytes(content["data"])) for _, _, content in topics["/can"]]
    assert said == [(identifier, bytes(data)) for _, identifier, _, data, _, _ in read_frames(log)]


@pytest.mark.parametrize("pack", [bytes, gzip.compress])
def test_the_file_replays_to_the_same_windows(mcap, windows, config, tmp_path, pack):
    path = tmp_path / "again"
    path.write_bytes(pack(mcap.read_bytes()))
    again = list(replay(Pipeline(config, load_databases(config)), [path]))
    assert [json_line(replace(w, log=""), config) for w in again] == [
        json_line(replace(w, log=""), config) for w in windows[:-1]
    ]


def test_messages_are_in_the_order_of_their_times(windows, config, tmp_path):
    write_mcap(tmp_path / "a.mcap", windows[::-1], config)
    with (tmp_path / "a.mcap").open("rb") as file:
        times = [message.log_time for *_, message in make_reader(file).iter_messages(log_time_order=False)]
    assert times == sorted(times)
