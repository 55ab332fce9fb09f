"""Sweeps: studies of pipelines, settings and seeds that survive any kill."""

from .definition import Definition as Definition
from .executors.executor import Executor as Executor
from .executors.executor import Job as Job
from .executors.executor import command_of as command_of
from .executors.executor import variables_of as variables_of
from .results import Result as Result
from .results import Trial as Trial
from .runner import run_study as run_study
from .study import Study as Study
