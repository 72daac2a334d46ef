"""The tables of Xi et al. 2024 (World Electr. Veh. J. 15:217) beside ours: `soilbus.paper.table(3)`."""

from __future__ import annotations

from soilbus.trials.paper_report import PaperTable, paper_table
from soilbus.trials.paper_tables import SINKAGE, START_ERRORS

__all__ = ["table"]


def table(number: int, sinkage: float = SINKAGE) -> PaperTable:
    """A table of estimates of the paper, its method run again on its own equations.

    Parameters
    ----------
    number
        3, 4, 6 or 7, of the paper.
    sinkage
        Of the simulated wheels [m], which the paper does not print.

    Returns
    -------
    PaperTable
        Its `rows` as figures; prints itself as a table: printed start, result, error and time beside the error that
        the printed result has, our result by the same iteration (eq. 41), its error, steps and time.

    Raises
    ------
    ValueError
        The paper has no such table, or no wheel sinks so deep.

    Examples
    --------
    >>> import soilbus
    >>> table = soilbus.paper.table(3)
    >>> for row in table.rows:
    ...     print(f"{row.parameter:<9}  {row.on:<10}  {row.printed:>8g}  {row.ours:.6g}")
    phi [deg]  wet clay     13.9671  14
    phi [deg]  sandy loam    29.004  29
    K_L        wet clay     635.522  644.9
    K_L        sandy loam   1539.01  1532.67
    n          wet clay      0.8498  0.85
    n          sandy loam     0.703  0.7
    """
    if number not in START_ERRORS:
        raise ValueError(f"no table {number} of estimates in the paper; there are {', '.join(map(str, START_ERRORS))}")
    return paper_table(number, sinkage)
