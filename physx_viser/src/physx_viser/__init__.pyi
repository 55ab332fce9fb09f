"""The physx plugin ``viser``: a hand on running environments, in a browser."""

from .version import __version__ as __version__
from .visualizer import ViserVisualizer as ViserVisualizer
