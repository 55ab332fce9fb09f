"""Checks that a component satisfies its contract, for plugin tests."""

from .buffer import check_buffer as check_buffer
from .environment import check_environment as check_environment
from .launcher import check_launcher as check_launcher
from .network import check_network as check_network
from .optimization import check_optimization as check_optimization
from .plugin import check_plugin as check_plugin
from .report import Check as Check
from .report import Report as Report
from .sampler import check_sampler as check_sampler
from .transformation import check_transformation as check_transformation
from .version import __version__ as __version__
from .visualizer import check_visualizer as check_visualizer
