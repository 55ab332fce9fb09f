"""Exchange: rows to and from files of other formats, block by block."""

from physx_core.dataset.exchange.exporting import FORMATS, ExportOptions, export
from physx_core.dataset.exchange.importing import import_file

__all__ = ["FORMATS", "ExportOptions", "export", "import_file"]
