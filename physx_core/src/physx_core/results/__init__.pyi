"""Results: what a run found, and how good its network is, compared with predictions without one."""

from .comparison import Comparison as Comparison
from .policy import ActionsResult as ActionsResult
from .policy import PolicyResult as PolicyResult
from .result import Drift as Drift
from .result import EpisodeError as EpisodeError
from .result import FieldResult as FieldResult
from .result import PartResult as PartResult
from .result import Result as Result
from .result import RivalResult as RivalResult
from .result import RolloutResult as RolloutResult
from .result import rollout_notes as rollout_notes
from .stored import read_finding as read_finding
from .stored import read_results as read_results
from .stored import store_finding as store_finding
from .stored import store_result as store_result
from .stored import write_finding as write_finding
from .sweep import SettingResult as SettingResult
from .sweep import SweepResult as SweepResult
