"""``physx generate``: generate samples with an environment and store them in a session."""

from __future__ import annotations

from collections.abc import Sequence

from physx_core.cli.pipeline_options import pipeline_from
from physx_core.pipelines.data_generation import DataGeneration


def run(words: Sequence[str]) -> None:
    """Generate samples; the first word is the environment."""
    pipeline_from(
        DataGeneration,
        "generate",
        ("environment.environment",),
        words,
        arguments="[ENVIRONMENT]",
        examples=(
            "dart/arm --batch-nb 100 --batch-size 32",
            "script.py:Class --environment.num-clients 4 --batch-nb 10 --batch-size 8",
            "--config config.toml",
        ),
    ).execute()
