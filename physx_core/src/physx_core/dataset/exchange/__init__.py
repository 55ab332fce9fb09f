"""Exports rows to files of other formats and imports them, block by block."""

from physx_core.dataset.exchange.exporting import FORMATS, export
from physx_core.dataset.exchange.importing import import_file
from physx_core.dataset.exchange.table import ExportOptions

__all__ = ["FORMATS", "ExportOptions", "export", "import_file"]
