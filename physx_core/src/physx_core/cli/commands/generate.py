"""``physx generate``: generate samples with an environment and store them in a session."""

from __future__ import annotations

from collections.abc import Sequence

from physx_core.cli.pipeline_options import pipeline_from, resumed
from physx_core.pipelines.data_generation import DataGeneration


def run(words: Sequence[str]) -> None:
    """Generate samples with the environment that the first word names.

    With ``--resume``, the first word is a session instead; its ``config.toml`` gives the options.
    """
    if "--resume" in words and "--session-name" not in words:
        words = resumed(words)
    pipeline_from(
        DataGeneration,
        "generate",
        ("environment.environment",),
        words,
        arguments="[ENVIRONMENT]",
        examples=(
            "dart/arm --batch-nb 100 --batch-size 32",
            "script.py:Class --environment.num-clients 4 --episodes 100",
            "sessions/data_generation --resume",
        ),
    ).execute()
