"""Exports and imports rows to and from files of other formats, block by block."""

from physx_core.dataset.exchange.exporting import FORMATS, export
from physx_core.dataset.exchange.importing import import_file
from physx_core.dataset.exchange.table import ExportOptions

__all__ = ["FORMATS", "ExportOptions", "export", "import_file"]
