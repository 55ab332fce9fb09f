"""A prediction in a running simulation against the network alone, in one process, one thread.

The baseline turns one sample into a tensor, runs the network without gradients, and turns its
output into an array. physx also does the rest of a step of `Prediction`: the environment's step
with the checks of its sample, the prediction in physical units, and passing it to the environment.
`Environment.get_prediction`, which a step may call, is measured as well. The environment itself
does nothing.

    python benchmarks/prediction.py --device cuda    # both on a GPU

Claims: at most twice as long, at most 50 µs more.
"""

from __future__ import annotations

import statistics
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import ClassVar

import numpy as np
import torch
from measure import claim, device, finish

from physx_core import (
    Dataset,
    DatasetConfig,
    Environment,
    EnvironmentConfig,
    Field,
    NetworkConfig,
    Prediction,
    Training,
)

CALLS, ROUNDS = 300, 15
CASES = {
    "small: (5,) -> (1,), FC [5, 5, 5, 1]": ([5, 5, 5, 1], (5,), (1,)),
    "medium: (1000, 3) -> (3,), FC [3000, 64, 3]": ([3000, 64, 3], (1000, 3), (3,)),
}


class Still(Environment):
    """Sets the same sample in each step, and ignores predictions."""

    latest: ClassVar[Still]

    def __init__(self, *, inputs: list[int], outputs: list[int], **kwargs: object) -> None:
        super().__init__(**kwargs)
        self.shapes = tuple(inputs), tuple(outputs)
        Still.latest = self

    def create(self) -> None:
        """Draw the sample."""
        self.x, self.y = (self.rng.random(shape) for shape in self.shapes)

    def init_database(self) -> None:
        """Define input and target."""
        names = ("input", "ground_truth")
        self.define_training_fields(
            [Field(name, shape) for name, shape in zip(names, self.shapes, strict=True)]
        )

    def step(self) -> None:
        """Set the sample."""
        self.set_training_data(input=self.x, ground_truth=self.y)


def durations(candidates: dict[str, Callable[[], object]]) -> dict[str, list[float]]:
    """Return the median time of a call in µs for each of several interleaved rounds."""
    measured: dict[str, list[float]] = {name: [] for name in candidates}
    for number in range(ROUNDS + 1):
        for name, call in candidates.items():
            times = []
            for _ in range(CALLS):
                begin = time.perf_counter_ns()
                call()
                times.append(time.perf_counter_ns() - begin)
            if number:
                measured[name].append(statistics.median(times) / 1000)
    return measured


def report(title: str, measured: dict[str, list[float]], baseline: str) -> list[bool]:
    """Print the times and return which claims are met."""
    print(title)
    met = []
    for name, values in measured.items():
        low, middle, high = min(values), statistics.median(values), max(values)
        print(f"  {name:28} {middle:8.1f} µs  [{low:.1f} .. {high:.1f}]")
    for name, values in measured.items():
        if name == baseline:
            continue
        pairs = list(zip(values, measured[baseline], strict=True))
        ratio = statistics.median(mine / base for mine, base in pairs)
        added = statistics.median(mine - base for mine, base in pairs)
        met.append(claim(f"{name}, times as long", ratio, at_most=2.0))
        met.append(claim(f"{name}, µs more", added, at_most=50.0))
    return met


def trained(root: Path, layers: list[int], ins: tuple[int, ...], outs: tuple[int, ...]) -> None:
    """Train a network briefly, in the session ``training``."""
    rng = np.random.default_rng(0)
    with Dataset.create(root / "data") as dataset:
        rows = {"input": rng.random((16, *ins)), "ground_truth": rng.random((16, *outs))}
        dataset.append("training", rows)
    network = NetworkConfig(
        "torch/fc", {"layers": layers}, loss="MSELoss", optimizer="Adam", device=device()
    )
    data = DatasetConfig(existing_dir=str(root / "data"), normalize=False)
    Training(network, data, session_dir=str(root), epoch_nb=1, batch_size=16).execute()


def compare(title: str, root: Path) -> list[bool]:
    """Measure one network and return which claims are met."""
    layers, ins, outs = CASES[title]
    trained(root, layers, ins, outs)
    environment = EnvironmentConfig(
        Still, {"inputs": list(ins), "outputs": list(outs)}, as_tcp_ip_client=False
    )
    place = device()
    pipeline = Prediction(NetworkConfig(device=place), environment, session_dir=str(root))
    with pipeline:
        pipeline.prediction_begin()
        stack = pipeline.learner.network.layers
        still, x = Still.latest, np.random.default_rng(0).random(ins)

        def alone() -> np.ndarray:
            with torch.no_grad():
                tensor = torch.as_tensor(x[np.newaxis], dtype=torch.float32).to(place)
                return stack(tensor.reshape(1, -1)).cpu().numpy()

        def step() -> None:
            pipeline.sample_begin()
            pipeline.predict()
            pipeline.sample_end()

        candidates = {
            "as_tensor, forward, numpy": alone,
            "step of Prediction": step,
            "get_prediction": lambda: still.get_prediction(input=x),
        }
        measured = durations(candidates)
        pipeline.prediction_end()
    return report(f"Prediction, {title}", measured, "as_tensor, forward, numpy")


def main() -> None:
    """Measure and print."""
    torch.set_num_threads(1)
    met = []
    for title in CASES:
        with tempfile.TemporaryDirectory() as name:
            met += compare(title, Path(name))
    finish(met)


if __name__ == "__main__":
    main()
