"""How long a diagnosis takes, in units of one linearisation of the same recording, on any machine."""

import time
from itertools import islice

import numpy as np
import pytest

from soilbus.diagnosis.diagnose import diagnose
from soilbus.estimation.assembly import prior_of
from soilbus.terra.effects.catalogue import CATALOGUE
from soilbus.terra.wheel import Soil
from tests.lab.blind.cases import cases
from tests.lab.blind.trial import record_of_case

MOST_LOOKS = 1800.0
"""Linearisations of the plain model, some 6 ms each on one quiet core, as which a diagnosis may count: 11 s.

The same 8 s in all as 1000 of them, when each took 8.4 ms: the slowest case took 5.8 s then and takes 5.0 s now.
"""


def seconds_of(work):
    begin = time.process_time()
    work()
    return time.process_time() - begin


def look(record, prior):
    """Least processor time of one linearisation of the instants to be learned from, without effects."""
    problem, soil = record.training, Soil(*prior.median.tolist())
    gains = np.zeros(problem.n_sensors)
    latents = problem.start(soil, gains)
    return min(seconds_of(lambda: problem.linearise(soil, gains, latents)) for _ in range(10))


def test_a_diagnosis_takes_as_long_as_some_hundred_looks():
    case = next(islice(cases("pair", 11), 14, None))
    record, prior = record_of_case(case), prior_of(case.config)
    before = look(record, prior)
    spent = []
    while len(spent) < 2:  # once more where the machine had something else to do
        spent.append(seconds_of(lambda: diagnose([record], prior, list(CATALOGUE.values()))))
        if spent[-1] < MOST_LOOKS * max(before, look(record, prior)):
            return
    pytest.fail(f"{case.id} took {spent} s, a look {before} s")
