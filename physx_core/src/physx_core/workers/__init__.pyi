"""Environments in processes of their own, stepped over TCP."""

from .instance import Instance as Instance
from .launchers import ClientProcess as ClientProcess
