"""Pipelines: data generation, training, prediction, and replay."""

from .branch import Branch as Branch
from .data_generation import DataGeneration as DataGeneration
from .evaluating import evaluate as evaluate
from .evaluating import trace_episode as trace_episode
from .learning.batches.drawn_rows import read_drawn_rows as read_drawn_rows
from .learning.learner import Learner as Learner
from .learning.loading import load_learner as load_learner
from .learning.unseen import Unseen as Unseen
from .learning.unseen import open_unseen as open_unseen
from .pipeline import Pipeline as Pipeline
from .prediction import Prediction as Prediction
from .redrawing import Redrawing as Redrawing
from .replay import Replay as Replay
from .training import Training as Training
