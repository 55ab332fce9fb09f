"""physx plugin `mujoco`: simulations of robots and objects with MuJoCo."""

from .simulation import MujocoBackend as MujocoBackend
from .version import __version__ as __version__
