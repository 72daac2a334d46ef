"""Seeded mutations of good inputs, for machines without a coverage-guided fuzzer and for the short run in the tests."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

TOKENS = (
    b"nan", b"inf", b"-1", b"0", b"1e309", b"99999999999999999999", b"\x00", b"\xff\xff", b"\n", b'"', b"[", b"]", b"{",
    b"}", b"=", b"#", b"|", b"@", b"(", b")", b";", b":", b".", b"\xc3\xa9", b"\xef\xbb\xbf", b"true", b"''",
)  # fmt: skip


def mutated(seeds: Sequence[bytes], rng: np.random.Generator) -> bytes:
    """One of the seeds with one to eight changes."""
    data = bytearray(seeds[int(rng.integers(len(seeds)))])
    for _ in range(int(rng.integers(1, 9))):
        place = int(rng.integers(len(data) + 1))
        length = int(min(rng.geometric(0.05), len(data) - place))
        match int(rng.integers(7)):
            case 0 if place < len(data):
                data[place] ^= 1 << int(rng.integers(8))
            case 1 if place < len(data):
                data[place] = int(rng.integers(256))
            case 2:
                del data[place : place + length]
            case 3:
                data[place:place] = TOKENS[rng.integers(len(TOKENS))]
            case 4:
                data[place:place] = data[place : place + length] * int(rng.integers(1, 4))
            case 5:
                data[place : place + length] = rng.bytes(length)
            case 6:
                other = seeds[int(rng.integers(len(seeds)))]
                start = int(rng.integers(len(other) + 1))
                data[place : place + length] = other[start : start + length]
    return bytes(data)
