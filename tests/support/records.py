"""Records of simulated drives, as the diagnosis takes them."""

from collections.abc import Callable, Collection

from soilbus.can.channels import Column
from soilbus.config.model import Config
from soilbus.diagnosis.options import DEFAULT, DiagnosisOptions
from soilbus.diagnosis.records import Record, record_of
from soilbus.estimation.assembly import model_of, rig_of, with_effects
from soilbus.simulator.recording import Recording, simulate
from soilbus.simulator.reference import reference_configuration
from soilbus.simulator.scenario import Scenario
from soilbus.terra.effects.effect import Active
from soilbus.trials.windows import bins_of

CONFIG = reference_configuration()
Edit = Callable[[Recording], dict[str, Column]]
"""Of a recording those channels that read something else."""


def recorded(
    scenario: Scenario,
    seed: int,
    *hidden: str | Active,
    config: Config = CONFIG,
    truth: Config | None = None,
    without: Collection[str] = (),
    edit: Edit = lambda recording: {},
    options: DiagnosisOptions = DEFAULT,
    name: str = "drive",
) -> Record:
    """The record of a drive with hidden effects (of `--effect` or with their values), all of it.

    config is what the diagnosis knows; truth is what drives, the same unless it is given.
    Channels in `without` are not heard.
    """
    driven = with_effects(truth or config, [effect for effect in hidden if isinstance(effect, str)])
    recording = simulate(driven, scenario, seed, tuple(effect for effect in hidden if isinstance(effect, Active)))
    channels = {n: c for n, c in (recording.channels | edit(recording)).items() if n not in without}
    window, settings = bins_of(config, channels).window(0.0, scenario.duration), config.estimator
    return record_of(name, window, rig_of(config), model_of(config), settings.min_speed, settings.max_turn, options)
