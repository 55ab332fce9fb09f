"""``physx train``: train a network on a dataset or on samples that an environment generates."""

from __future__ import annotations

from collections.abc import Sequence

from physx_core.cli.pipeline_options import pipeline_from, resumed
from physx_core.pipelines.training import Training


def run(words: Sequence[str]) -> None:
    """Train on the dataset that the first word names.

    With ``--resume``, the first word is a session instead; its ``config.toml`` gives the options.
    """
    if "--resume" in words and "--session-name" not in words:
        words = resumed(words)
    pipeline_from(
        Training,
        "train",
        ("dataset.existing_dir",),
        words,
        arguments="[DATASET]",
        examples=(
            "sessions/data_generation --network.network toy/linear --epoch-nb 10 --batch-size 32",
            "sessions/training --resume --epoch-nb 20",
            "--config sessions/training",
        ),
    ).execute()
