"""``physx replay``: send stored samples through their environment to view them."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any

from physx_core.cli.pipeline_options import pipeline_from
from physx_core.cli.visualizers import visualizer_plugins
from physx_core.dataset import Dataset
from physx_core.errors import UsageError, listed
from physx_core.pipelines.replay import Replay, recorded_environment

_VISUALIZER = "--environment.visualizer"


def run(words: Sequence[str]) -> None:
    """Replay samples; the first word is a session's or dataset's folder.

    The environment is the second word, by default the one that generated the dataset. It is drawn
    with the given visualizer, by default that of the only installed visualizer plugin. ``--mode``
    is short for ``--dataset.mode``.
    """
    words = ["--dataset.mode" if word == "--mode" else word for word in words]
    place = ("dataset.existing_dir", "environment.environment")
    is_given = any(word.partition("=")[0] == _VISUALIZER for word in words)
    viewers = [] if is_given else visualizer_plugins()  # finding them imports all plugins
    viewer = {"visualizer": viewers[0]} if len(viewers) == 1 else {}
    pipeline = pipeline_from(
        Replay,
        "replay",
        place,
        words,
        _given(words, viewer),
        arguments="[DATASET] [ENVIRONMENT]",
        examples=(
            "sessions/data_generation",
            "sessions/data_generation dart/arm --environment.visualizer rerun",
            "sessions/training --mode validation",
        ),
    )
    config = pipeline.environment_config
    if config is not None and config.visualizer is None and not is_given:
        raise UsageError(
            f"physx replay needs {_VISUALIZER} REFERENCE unless exactly one visualizer plugin is "
            f"installed. Installed: {listed(viewers)}. (None: draw nothing.)"
        )
    pipeline.execute()


def _given(words: Sequence[str], plain: dict[str, Any]) -> dict[str, Any]:
    """Return default options of the environment: `plain`, and those recorded in the dataset."""
    named = list(itertools.takewhile(lambda word: not word.startswith("-"), words))
    environment = named[1] if len(named) > 1 else _value(words, "--environment.environment")
    if named:
        with Dataset.open(named[0]) as dataset:
            plain |= recorded_environment(dataset, environment, trust="--trust" in words)
    elif environment is None:
        return {}
    plain.pop("environment" if environment else "", None)
    return {"environment": plain}


def _value(words: Sequence[str], option: str) -> str | None:
    """Return the word after an option."""
    return words[words.index(option) + 1] if option in words[:-1] else None
