"""Block letters: words in pixels of a terminal, readable from the driver's seat.

A letter is a pattern of 5 rows of 3 to 5 pixels. `in_cells` makes a pixel of whole cells, as many as fit;
`in_half_cells` makes two rows of pixels of one row of cells, so that a pixel is nearly square.
"""

from __future__ import annotations

PIXEL_ROWS = 5
LETTERS = {
    "A": ".##./#..#/####/#..#/#..#", "B": "###./#..#/###./#..#/###.", "C": ".###/#.../#.../#.../.###",
    "D": "###./#..#/#..#/#..#/###.", "E": "####/#.../###./#.../####", "F": "####/#.../###./#.../#...",
    "G": ".###/#.../#.##/#..#/.###", "H": "#..#/#..#/####/#..#/#..#", "I": "###/.#./.#./.#./###",
    "J": "..##/...#/...#/#..#/.##.", "K": "#..#/#.#./##../#.#./#..#", "L": "#.../#.../#.../#.../####",
    "M": "#...#/##.##/#.#.#/#...#/#...#", "N": "#..#/##.#/#.##/#..#/#..#", "O": ".##./#..#/#..#/#..#/.##.",
    "P": "###./#..#/###./#.../#...", "Q": ".##./#..#/#..#/#.##/.###", "R": "###./#..#/###./#.#./#..#",
    "S": ".###/#.../.##./...#/###.", "T": "#####/..#../..#../..#../..#..", "U": "#..#/#..#/#..#/#..#/.##.",
    "V": "#...#/#...#/#...#/.#.#./..#..", "W": "#...#/#...#/#.#.#/##.##/#...#", "X": "#..#/#..#/.##./#..#/#..#",
    "Y": "#...#/.#.#./..#../..#../..#..", "Z": "####/...#/.##./#.../####", "-": ".../.../###/.../...",
    " ": "../../../../..", ",": "../../../.#/#.",
}  # fmt: skip
HALVES = {"..": " ", "#.": "▀", ".#": "▄", "##": "█"}
"""Cell of an upper and a lower pixel."""


def pixels(word: str) -> list[str]:
    """Return the rows of pixels (`#` and `.`) of a word in capitals, one empty column between letters.

    Raises
    ------
    KeyError
        A character has no pattern.
    """
    letters = [LETTERS[letter].split("/") for letter in word.upper()]
    return [".".join(letter[row] for letter in letters) for row in range(PIXEL_ROWS)]


def in_cells(word: str, width: int, height: int) -> list[str]:
    """Return the lines of a word as large as fits into `width` columns and `height` rows; none where it does not fit.

    A pixel is at most two and a half times as wide as high in cells, that is hardly wider than high to the eye.
    """
    rows = pixels(word)
    tall = height // PIXEL_ROWS
    wide = min(width // len(rows[0]), 5 * tall // 2)
    if min(tall, wide) < 1:
        return []
    lines = ["".join(("█" if pixel == "#" else " ") * wide for pixel in row) for row in rows]
    return [line for line in lines for _ in range(tall)]


def in_half_cells(word: str, width: int) -> list[str]:
    """Return three lines of a word below half an empty one; none where it is wider than `width` columns."""
    rows = pixels(word)
    if len(rows[0]) > width:
        return []
    rows.insert(0, "." * len(rows[0]))
    return [
        "".join(HALVES[upper + lower] for upper, lower in zip(rows[i], rows[i + 1], strict=True))
        for i in range(0, len(rows), 2)
    ]
