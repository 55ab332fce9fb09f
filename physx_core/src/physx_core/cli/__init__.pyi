"""The command ``physx``: its commands are entry points, which other packages may add to."""

from .arguments import argument_registry as argument_registry
from .command import GROUP as GROUP
from .command import main as main
