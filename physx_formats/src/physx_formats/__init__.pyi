"""Exports datasets to files of other formats, and imports them, block by block."""

from .errors import ExchangeError as ExchangeError
from .format import Format as Format
from .format import all_formats as all_formats
from .format import find_format as find_format
from .table import ArrayColumn as ArrayColumn
from .table import Column as Column
from .table import ExportOptions as ExportOptions
from .table import Notes as Notes
from .table import Table as Table
from .table import encode_notes as encode_notes
from .transfer.editing import edit as edit
from .transfer.exporting import export as export
from .transfer.importing import import_file as import_file
from .version import __version__ as __version__
