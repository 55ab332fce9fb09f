"""Environments in processes of their own, stepped over TCP."""

from .instance import Instance as Instance
from .instance import instance_arguments as instance_arguments
from .launchers import ClientProcess as ClientProcess
