"""Identification: parameters of robots from logs, with intervals that hold."""

from .actuator import Actuators as Actuators
from .actuator import learn_actuators as learn_actuators
from .actuator import write_learned as write_learned
from .estimation.model import Model as Model
from .estimation.structure import ResidualTest as ResidualTest
from .excitation import Motion as Motion
from .excitation import propose as propose
from .excitation import write_motion as write_motion
from .identify import identify as identify
from .logs.checks import check_log as check_log
from .logs.log import Log as Log
from .logs.log import read_log as read_log
from .randomization import Identified as Identified
from .result.estimates import Combination as Combination
from .result.estimates import EngineFit as EngineFit
from .result.estimates import Estimate as Estimate
from .result.estimates import LogNoise as LogNoise
from .result.identification import Identification as Identification
from .result.stored import read_identification as read_identification
from .result.stored import store_identification as store_identification
from .result.stored import write_identification as write_identification
from .unknowns import Unknown as Unknown
from .version import __version__ as __version__
