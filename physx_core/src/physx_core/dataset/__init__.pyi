"""Datasets: samples in HDF5 partitions, written at disk speed and crash-safe at all times.

The format is documented in `physx_core.dataset.store`: `partition.format` and `manifest`.
"""

from .dataset import Dataset as Dataset
from .read.episodes import Episode as Episode
from .read.episodes import Trajectories as Trajectories
from .read.episodes import find_episodes as find_episodes
from .read.episodes import find_trajectories as find_trajectories
from .read.mode_rows import ModeRows as ModeRows
from .read.mode_rows import Snapshot as Snapshot
from .read.order.records import RecordedEpisodes as RecordedEpisodes
from .read.progress import Progress as Progress
from .read.views import ModeView as ModeView
from .repair.recovery import holds_dataset as holds_dataset
from .store.episode_record import EpisodeRecord as EpisodeRecord
from .store.episode_record import EpisodeStatus as EpisodeStatus
from .store.episode_table import EPISODES as EPISODES
from .store.episode_table import TABLE_FIELDS as TABLE_FIELDS
from .store.failure_file import FailedEpisode as FailedEpisode
from .store.partition.format import hdf5_type as hdf5_type
from .store.partition.segment import rows_per_block as rows_per_block
