"""physx plugins `dart` and `pinocchio`: robot simulations, and environments with them."""

from .dart.simulation import DartBackend as DartBackend
from .environments.arm import DartArm as DartArm
from .environments.arm import PinocchioArm as PinocchioArm
from .environments.double_pendulum import DartDoublePendulum as DartDoublePendulum
from .environments.double_pendulum import PinocchioDoublePendulum as PinocchioDoublePendulum
from .pinocchio.simulation import PinocchioBackend as PinocchioBackend
from .version import __version__ as __version__
