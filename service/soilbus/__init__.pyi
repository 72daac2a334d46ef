from soilbus.api import paper as paper
from soilbus.api.estimate import SingleWheelRig as SingleWheelRig
from soilbus.api.estimate import estimate as estimate
from soilbus.api.recordings import diagnose as diagnose
from soilbus.api.recordings import replay as replay
from soilbus.api.recordings import signals as signals
from soilbus.api.recordings import simulate as simulate
from soilbus.api.wheel import wheel_forces as wheel_forces
from soilbus.config.file import load_config as load_config
from soilbus.terra.soils import soil_named as soil_named
from soilbus.terra.wheel import Soil as Soil

__version__: str
