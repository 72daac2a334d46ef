"""Numbers on the command line, for argparse: each a parser that refuses with one clear line."""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable


def between(low: float, high: float) -> Callable[[str], float]:
    """Parser of a number in a range, for argparse."""

    def number(text: str) -> float:
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not low <= value <= high:
            raise argparse.ArgumentTypeError(f"{text} is not a number from {low:g} to {high:g}")
        return value

    return number


def natural(text: str) -> int:
    """Parser of a whole number that is not negative, for argparse."""
    if not text.isdecimal():
        raise argparse.ArgumentTypeError(f"{text} is not a whole number from 0 up")
    return int(text)


def counted(text: str) -> int:
    """Parser of a whole number above zero, for argparse."""
    number = natural(text)
    if number == 0:
        raise argparse.ArgumentTypeError("0 is not enough")
    return number
