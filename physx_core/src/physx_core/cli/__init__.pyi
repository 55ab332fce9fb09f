"""The command ``physx``, whose subcommands are entry points that other packages can add."""

from .command import main as main
from .commands.stats import spark_line as spark_line
from .dataset_tables import count as count
from .options import options_from as options_from
from .output import in_notebook as in_notebook
from .output import show as show
from .output import show_table as show_table
from .output import width as width
