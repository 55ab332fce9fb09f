"""Agreement of physics engines: how far they agree on a task, and why they part."""

from .agreement import Agreement as Agreement
from .causes import Cause as Cause
from .causes import Parting as Parting
from .scores import Ranking as Ranking
from .scores import Score as Score
from .stored import read_agreement as read_agreement
from .stored import store_agreement as store_agreement
from .study import agree as agree
from .version import __version__ as __version__
