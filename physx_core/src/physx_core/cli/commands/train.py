"""``physx train``: train a network on a dataset, or on samples that an environment generates."""

from __future__ import annotations

import math
from collections.abc import Sequence

from physx_core.cli.pipeline_options import pipeline_from
from physx_core.pipelines.training import Training


def run(words: Sequence[str]) -> None:
    """Train, and print the last losses and the network's folder."""
    pipeline = pipeline_from(Training, "train", ("dataset.existing_dir",), words)
    pipeline.execute()
    if not pipeline.group.leads:
        return
    print(f"training loss {pipeline.training_loss:.6g}")
    if not math.isnan(pipeline.validation_loss):
        print(f"validation loss {pipeline.validation_loss:.6g}")
    if not math.isinf(pipeline.best.loss):
        print(f"smallest loss {pipeline.best.loss:.6g}, after epoch {pipeline.best.epoch}")
    print(f"network: {pipeline.checkpoint_path}")
