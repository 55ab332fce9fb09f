"""Datasets: samples in HDF5 partitions, written at disk speed and crash-safe at all times.

The format is documented in `physx_core.dataset.store`: `partition.format` and `manifest`.
"""

from __future__ import annotations

from physx_core.dataset.dataset import Dataset
from physx_core.dataset.read.episodes import Episode, find_episodes
from physx_core.dataset.read.order.records import RecordedEpisodes
from physx_core.dataset.read.progress import Progress
from physx_core.dataset.read.splits import Subset
from physx_core.dataset.read.views import ModeView
from physx_core.dataset.repair.recovery import holds_dataset
from physx_core.dataset.store.episode_table import EPISODES, TABLE_FIELDS, EpisodeStatus
from physx_core.dataset.store.failure_file import FailedEpisode
from physx_core.dataset.store.partition.segment import rows_per_block
from physx_core.dataset.write.recording import EpisodeRecord

__all__ = [
    "EPISODES",
    "TABLE_FIELDS",
    "Dataset",
    "Episode",
    "EpisodeRecord",
    "EpisodeStatus",
    "FailedEpisode",
    "ModeView",
    "Progress",
    "RecordedEpisodes",
    "Subset",
    "find_episodes",
    "holds_dataset",
    "rows_per_block",
]
