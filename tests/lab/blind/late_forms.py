"""Hidden effects: delays of channels other than the torque.  They stand last in the list of forms."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from soilbus.arrays import Array
from soilbus.can.channels import Column
from soilbus.simulator.recording import Recording
from soilbus.terra.effects.effect import Surroundings
from tests.lab.blind.form import Form, Hidden, Setting, Sizes, by_hooks


def _from_a_receiver(size: float, setting: Setting) -> Hidden:
    """The ground speed of a receiver of positions: whole samples late."""

    def late(recording: Recording) -> Recording:
        column = recording.channels["ground_speed"]
        behind = round(size / float(np.median(np.diff(column.t))))
        value = column.value[np.maximum(np.arange(len(column.t)) - behind, 0)]
        return replace(recording, channels=recording.channels | {"ground_speed": Column(column.t, value)})

    return Hidden(after=late)


def _averaged(draft: Array, around: Surroundings, values: Sizes) -> Array:
    """The error of a draft that is the mean over the last `size` [s]."""
    t = np.ravel(around.t)
    area = np.concatenate([[0.0], np.cumsum((draft[1:] + draft[:-1]) / 2.0 * np.diff(t))])
    begin = np.maximum(t - values["size"], t[0])
    span = np.maximum(t - begin, 1e-9)
    return np.asarray(np.where(t > t[0], (area - np.interp(begin, t, area)) / span, draft) - draft)


FORMS = (
    Form("channel_lag", "receiver", "speed of a receiver of positions, 0.1 to 0.3 s late", "s", (0.04, 0.04), 0.4,
         _from_a_receiver),
    Form("channel_lag", "averaged_draft", "mean of a time before", "s", (0.06, 0.06), 0.8, by_hooks(draft=_averaged)),
)  # fmt: skip
