"""Sources of samples: environments in this process, or in clients over TCP."""

from .client_source import ClientSource as ClientSource
from .local_source import LocalSource as LocalSource
from .source import Source as Source
