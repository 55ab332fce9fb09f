"""Checks that a component keeps its contract, for the tests of plugins."""

from .report import Check as Check
from .report import NotApplicableError as NotApplicableError
from .report import Report as Report
from .visualizer import check_visualizer as check_visualizer
