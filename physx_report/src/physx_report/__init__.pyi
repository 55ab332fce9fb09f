"""Writes what a run found to one HTML page."""

from .blocks import Figure as Figure
from .blocks import Picture as Picture
from .blocks import Table as Table
from .blocks import Text as Text
from .page import show as show
from .page import write_report as write_report
from .run import Run as Run
from .section import Section as Section
from .version import __version__ as __version__
