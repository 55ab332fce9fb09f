"""``physx predict``: run an environment with a session's network."""

from __future__ import annotations

from collections.abc import Sequence

from physx_core.cli.pipeline_options import pipeline_from, take_session
from physx_core.pipelines.prediction import Prediction


def run(words: Sequence[str]) -> None:
    """Run a prediction; the first word is a session's folder."""
    _, words = take_session(words)
    pipeline_from(
        Prediction,
        "predict",
        ("environment.environment",),
        words,
        arguments="[SESSION] [ENVIRONMENT]",
        examples=(
            "sessions/training dart/arm --step-nb 100",
            "sessions/training dart/arm --environment.visualizer rerun",
            "sessions/training script.py:Class --record",
        ),
    ).execute()
