"""``physx train``: train a network on a dataset or on samples that an environment generates."""

from __future__ import annotations

from collections.abc import Sequence

from physx_core.cli.pipeline_options import pipeline_from, take_session
from physx_core.pipelines.training import Training
from physx_core.session import Session


def run(words: Sequence[str]) -> None:
    """Train on the dataset that the first word names.

    With ``--resume``, the first word is a session instead; its ``config.toml`` gives the options.
    """
    if "--resume" in words and "--session-name" not in words:
        session, words = take_session(words)
        if session is not None:
            Session.existing(session.parent, session.name)
            given = [] if "--config" in words else ["--config", str(session)]
            words = [*given, *words]
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
