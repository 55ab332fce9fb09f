"""``physx replay``: send stored samples through their environment, to view them."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any

from physx_core.cli.pipeline_options import pipeline_from
from physx_core.dataset import Dataset
from physx_core.pipelines.replay import Replay, recorded_environment
from physx_core.plugins import available

_VIEWER = "rerun"


def run(words: Sequence[str]) -> None:
    """Replay as the words say; the first is a session's or dataset's folder.

    The environment is the second word, or else what the dataset says to have been made with. It is
    drawn with the visualizer that is chosen, or else with Rerun, if that is installed. ``--mode``
    is short for ``--dataset.mode``.
    """
    words = ["--dataset.mode" if word == "--mode" else word for word in words]
    place = ("dataset.existing_dir", "environment.environment")
    pipeline = pipeline_from(Replay, "replay", place, words, _given(words))
    pipeline.execute()
    config = pipeline.environment_config
    print(f"{pipeline.step_id} steps of {config.environment if config else ''}")
    print(f"session: {pipeline.session.path}")


def _given(words: Sequence[str]) -> dict[str, Any]:
    """Return the options of the environment that need not be typed."""
    named = list(itertools.takewhile(lambda word: not word.startswith("-"), words))
    plain: dict[str, Any] = {"visualizer": _VIEWER} if _VIEWER in available() else {}
    if len(named) == 1 and "--environment.environment" not in words:
        with Dataset.open(named[0]) as dataset:
            plain |= recorded_environment(dataset)
    elif len(named) < 2 and "--environment.environment" not in words:
        return {}
    return {"environment": plain}
