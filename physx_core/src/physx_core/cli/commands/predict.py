"""``physx predict``: run an environment with a session's network."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from physx_core.cli.pipeline_options import pipeline_from
from physx_core.pipelines.prediction import Prediction


def run(words: Sequence[str]) -> None:
    """Run a prediction; the first word is a session's folder."""
    words = list(words)
    if words and not words[0].startswith("-"):
        session = Path(words.pop(0))
        words += ["--session-dir", str(session.parent), "--session-name", session.name]
    pipeline = pipeline_from(Prediction, "predict", ("environment.environment",), words)
    pipeline.execute()
    print(f"{pipeline.step_id} steps with {pipeline.learner.config.network}")
    if pipeline.record:
        print(f"recorded: {pipeline.session.dataset_dir}")
