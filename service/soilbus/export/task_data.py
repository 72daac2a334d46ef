"""Windows as ISOXML task data (ISO 11783-10, version 4.3), for farm management software.

    TASKDATA.XML             the device, its values and a finished task for each log
    TLG00001.xml, .bin       time log of the first task: time, position and values of each window with a position

DDI 470 "soil compaction" is a code: 0 not defined, 1 loose, 2 slightly compacted, 3 compacted, 4 very compacted.  We
make it of the bearing pressure of valid windows by `output.compaction`; 0 is said, not left out, where there is none,
for readers let a value hold until the next one.  Numbers stand under proprietary DDIs, described in TASKDATA.XML.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Iterable, Iterator, Sequence
from datetime import UTC, datetime, timedelta
from itertools import groupby
from pathlib import Path
from typing import NamedTuple
from xml.etree import ElementTree

import numpy as np

from soilbus import __version__
from soilbus.can.j1939 import name_of
from soilbus.config.model import Config
from soilbus.decision.traversability import State, Status
from soilbus.files import NotWritten, whole_file, whole_file_of_bytes
from soilbus.pipeline.result import WindowResult

EPOCH = datetime(1980, 1, 1, tzinfo=UTC)
"""Day 0 of a time log."""
LAST_DAY = datetime(2159, 6, 6, tzinfo=UTC)
"""Day 65535, the last one that it can write."""
COMPACTION = 470
"""DDI "soil compaction" of ISO 11783-11."""
FIRST_PROPRIETARY_DDI = 57344
"""ISO 11783-11 leaves 57344 to 65534 to manufacturers."""
STRUCTURE, LOCALISATION = "01000000000000", "FF000000006E65"
"""Labels of the device: of its structure, first version; of its language, English."""
STATES = (State.UNKNOWN, State.NO_GO, State.CAUTION, State.GO)
"""The traversability's states in the order of their codes in soilbus.dbc."""
LARGEST = 2**31 - 1


class Quantity(NamedTuple):
    """Meaning of a DDI: name, unit that people read, value of a step of the integer, decimals to show."""

    name: str
    unit: str
    step: float
    decimals: int


QUANTITIES = {
    COMPACTION: Quantity("Soil compaction", "", 1.0, 0),
    FIRST_PROPRIETARY_DDI: Quantity("Bearing pressure", "kPa", 0.001, 1),
    FIRST_PROPRIETARY_DDI + 1: Quantity("Bearing pressure, std", "kPa", 0.001, 1),
    FIRST_PROPRIETARY_DDI + 2: Quantity("Friction angle", "deg", 0.001, 1),
    FIRST_PROPRIETARY_DDI + 3: Quantity("Friction angle, std", "deg", 0.001, 1),
    FIRST_PROPRIETARY_DDI + 4: Quantity("Largest draft", "kN", 0.001, 2),
    FIRST_PROPRIETARY_DDI + 5: Quantity("Largest draft, std", "kN", 0.001, 2),
    FIRST_PROPRIETARY_DDI + 6: Quantity("Traversability", "", 1.0, 0),
}


def compaction_code(result: WindowResult, bounds: Sequence[float]) -> int:
    """Return DDI 470 of a window: 1 to 4 by its bearing pressure between `bounds` [Pa]; 0 if not valid."""
    if result.status is not Status.VALID or result.bearing is None:
        return 0
    return 1 + bisect_right(bounds, result.bearing.value)


def write_task_data(folder: Path, results: Iterable[WindowResult], config: Config) -> int:
    """Write the files of all windows with a position into a folder, which is made if need be; NotWritten.

    It returns the number of windows left out: without a position, or of a time before 1980, which a time log cannot
    hold.
    """
    every = list(results)
    first, last = EPOCH.timestamp(), LAST_DAY.timestamp()
    kept = [result for result in every if result.position is not None and first <= result.t < last]
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise NotWritten(f"{folder}: {error.strerror or error}") from None
    client = f"{name_of(config.j1939):016X}"
    root = _root(client)
    for n, (log, group) in enumerate(groupby(kept, lambda result: result.log), start=1):
        windows = list(group)
        name, records = f"TLG{n:05}", b"".join(_record(result, config.output.compaction) for result in windows)
        with whole_file_of_bytes(folder / f"{name}.bin") as binary:
            binary.write(records)
        _write(folder / f"{name}.xml", _header())
        task = _add_task(root, n, log or "live", windows)
        ElementTree.SubElement(task, "DAN", A=client, C="DVC1")
        ElementTree.SubElement(task, "TLG", A=name, B=str(len(records)), C="1")
    _write(folder / "TASKDATA.XML", root)
    return len(every) - len(kept)


def _values(result: WindowResult, bounds: Sequence[float]) -> Iterator[tuple[int, float]]:
    """DDI and value, in the unit that people read, of what a window knows."""
    yield COMPACTION, compaction_code(result, bounds)
    phi = None if result.posterior is None else result.posterior.parameters()["phi"]
    estimates = ((result.bearing, 1e3), (phi, math.pi / 180.0), (result.traversability.max_draft, 1e3))
    for n, (estimate, unit) in enumerate(estimates):
        if estimate is not None:
            yield FIRST_PROPRIETARY_DDI + 2 * n, estimate.value / unit
            yield FIRST_PROPRIETARY_DDI + 2 * n + 1, estimate.std / unit
    yield FIRST_PROPRIETARY_DDI + 6, STATES.index(result.traversability.state)


def _record(result: WindowResult, bounds: Sequence[float]) -> bytes:
    """A window in the time log: time, position, then number and value of each quantity, little endian, packed."""
    assert result.position is not None
    since = timedelta(seconds=result.t - EPOCH.timestamp())
    milliseconds = since.seconds * 1000 + since.microseconds // 1000
    latitude, longitude = (round(math.degrees(angle) * 1e7) for angle in result.position)
    head = np.array([(milliseconds, since.days, latitude, longitude)], "<u4, <u2, <i4, <i4").tobytes()
    ddis = list(QUANTITIES)
    steps = {ddi: round(value / QUANTITIES[ddi].step) for ddi, value in _values(result, bounds) if math.isfinite(value)}
    pairs = [(ddis.index(ddi), step) for ddi, step in steps.items() if abs(step) <= LARGEST]
    return head + bytes([len(pairs)]) + np.array(pairs, "u1, <i4").tobytes()


def _header() -> ElementTree.Element:
    """TLG….xml: what a record holds; an empty attribute is one that each record gives."""
    time = ElementTree.Element("TIM", A="", D="4")
    ElementTree.SubElement(time, "PTN", A="", B="", D="15")  # 15: the receiver's status is not available
    for ddi in QUANTITIES:
        ElementTree.SubElement(time, "DLV", A=f"{ddi:04X}", B="", C="DET1")
    return time


def _root(name: str) -> ElementTree.Element:
    """TASKDATA.XML without tasks: the device with its element and the description of each quantity."""
    root = ElementTree.Element(
        "ISO11783_TaskData", VersionMajor="4", VersionMinor="3", DataTransferOrigin="2",
        ManagementSoftwareManufacturer="the soilbus authors", ManagementSoftwareVersion=__version__,
        TaskControllerManufacturer="the soilbus authors", TaskControllerVersion=__version__,
    )  # fmt: skip
    below, first, shown = ElementTree.SubElement, 2, 2 + len(QUANTITIES)
    device = below(root, "DVC", A="DVC1", B="soilbus", C=__version__, D=name, F=STRUCTURE, G=LOCALISATION)
    element = below(device, "DET", A="DET1", B="1", C="1", D="soilbus", E="0", F="0")
    for n in range(first, shown):
        below(element, "DOR", A=str(n))
    for n, (ddi, quantity) in enumerate(QUANTITIES.items()):
        below(device, "DPD", A=str(first + n), B=f"{ddi:04X}", C="0", D="1", E=quantity.name, F=str(shown + n))
    for n, of in enumerate(QUANTITIES.values(), shown):
        below(device, "DVP", A=str(n), B="0", C=f"{of.step:g}", D=str(of.decimals), E=of.unit)
    return root


def _add_task(root: ElementTree.Element, n: int, log: str, windows: Sequence[WindowResult]) -> ElementTree.Element:
    """A finished task: from the earliest to the latest window of a log."""
    task = ElementTree.SubElement(root, "TSK", A=f"TSK{n}", B=f"soilbus {log}"[:32], G="4")
    times = [w.t for w in windows]  # the clock may be set back
    begin, end = (datetime.fromtimestamp(t, UTC).strftime("%Y-%m-%dT%H:%M:%SZ") for t in (min(times), max(times)))
    ElementTree.SubElement(task, "TIM", A=begin, B=end, D="4")
    return task


def _write(path: Path, root: ElementTree.Element) -> None:
    ElementTree.indent(root)
    with whole_file(path) as out:
        out.write('<?xml version="1.0" encoding="UTF-8"?>\n' + ElementTree.tostring(root, "unicode") + "\n")
