"""Parameter groups of identifiers, against the standard's own numbers (SAE J1939-21, ISO 11783-3)."""

import pytest

from soilbus.can.j1939 import group_mask, pgn_of, source_of


@pytest.mark.parametrize(
    ("arbitration_id", "group", "source"),
    [
        (0x0C000003, 0, 0x03),  # torque/speed control 1, to the engine
        (0x18EEFF26, 60928, 0x26),  # address claimed, to all
        (0x18EF1C26, 61184, 0x26),  # proprietary A, to 1C: the last format with a destination
        (0x18F00027, 61440, 0x27),  # electronic retarder 1: the first format without one
        (0x0CF00400, 61444, 0x00),  # engine controller 1
        (0x18FE49A0, 65097, 0xA0),  # ground based speed and distance
        (0x18FF649A, 65380, 0x9A),  # proprietary B
        (0x1CFFFFFE, 65535, 0xFE),
        (0x09F80103, 129025, 0x03),  # position, rapid update (NMEA 2000), on data page 1
        (0x0DEF0103, 126720, 0x03),  # proprietary A of data page 1 (NMEA 2000), to 01
    ],
)
def test_the_group_and_the_source_of_an_identifier(arbitration_id, group, source):
    assert pgn_of(arbitration_id) == group
    assert source_of(arbitration_id) == source


@pytest.mark.parametrize("format_", range(0x100))
def test_a_destination_is_no_part_of_the_group_and_all_else_is(format_):
    base = 0x18000000 | format_ << 16
    groups = {pgn_of(base | specific << 8 | 0x26) for specific in range(0x100)}
    assert len(groups) == (1 if format_ < 240 else 256)
    assert all(pgn_of(base | 0x100 | source) == pgn_of(base | 0x100) for source in range(0x100))
    assert group_mask(base) & 0xFF == 0
