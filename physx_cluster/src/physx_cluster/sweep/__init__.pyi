"""Sweeps: studies of pipelines, settings and seeds that survive any kill."""

from .definition import Definition as Definition
from .results import Result as Result
from .results import Trial as Trial
from .runner import run_study as run_study
from .study import Study as Study
