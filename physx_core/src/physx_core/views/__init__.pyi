"""Views: which rows of which datasets a network learns from, in which form and order."""

from .batches import Batches as Batches
from .dataset_config import DatasetConfig as DatasetConfig
from .folds import Part as Part
from .view import View as View
