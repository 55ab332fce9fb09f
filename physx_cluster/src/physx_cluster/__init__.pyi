"""The physx plugin ``cluster``: clients of a run on Ray and on Slurm."""

from .launchers.ray import RayLauncher as RayLauncher
from .launchers.slurm import SlurmLauncher as SlurmLauncher
from .version import __version__ as __version__
