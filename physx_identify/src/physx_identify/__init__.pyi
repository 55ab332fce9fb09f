"""Identification: parameters of robots from logs, with intervals that hold."""

from .actuator import Actuators as Actuators
from .actuator import learn_actuators as learn_actuators
from .actuator import write_learned as write_learned
from .checks import check_log as check_log
from .estimates import Combination as Combination
from .estimates import Estimate as Estimate
from .estimates import LogNoise as LogNoise
from .excitation import Motion as Motion
from .excitation import propose as propose
from .excitation import write_motion as write_motion
from .identification import Identification as Identification
from .identify import identify as identify
from .log import Log as Log
from .log import read_log as read_log
from .model import Model as Model
from .randomization import Identified as Identified
from .stored import read_identification as read_identification
from .stored import store_identification as store_identification
from .stored import write_identification as write_identification
from .structure import ResidualTest as ResidualTest
from .unknowns import Unknown as Unknown
from .version import __version__ as __version__
