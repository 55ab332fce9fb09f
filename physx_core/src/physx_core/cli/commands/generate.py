"""``physx generate``: generate samples with an environment and store them in a session."""

from __future__ import annotations

import time
from collections.abc import Sequence

from physx_core.cli.pipeline_options import pipeline_from
from physx_core.pipelines.data_generation import DataGeneration


def run(words: Sequence[str]) -> None:
    """Generate samples and print the time that it took, including the start of the clients."""
    pipeline = pipeline_from(DataGeneration, "generate", ("environment.environment",), words)
    begin = time.perf_counter()
    pipeline.execute()
    duration = time.perf_counter() - begin
    samples = pipeline.batch_nb * pipeline.batch_size
    print(f"{samples} samples in {duration:.2f} s, {samples / duration:.0f} samples/s")
    print(f"session: {pipeline.session.path}")
