"""Data generation with one environment, or with several in parallel.

An environment is a class whose step sets one sample: here, a random cloud of points and its spread.
First, one environment in this process fills a dataset with fields, units and statistics. Then one
and four clients, each in its own process, do the same with steps that take 5 ms: four clients are
about four times as fast. Each row records which instance generated it. With n instances, row r
comes from instance r modulo n, however fast each of them is, so the same seed gives the same rows.

    python examples/01_generate.py
"""

from __future__ import annotations

import time

from common import options
from environments.cloud import Cloud
from matplotlib.figure import Figure

from physx_core import DataGeneration, Dataset, EnvironmentConfig


class Timed(DataGeneration):
    """Measures the time from the first batch to the last; starting the clients is not timed."""

    def data_generation_begin(self) -> None:
        self.begin = time.perf_counter()

    def data_generation_end(self) -> None:
        self.rate = self.batch_nb * self.batch_size / (time.perf_counter() - self.begin)


def draw(path, clouds, spreads) -> None:
    """Draw some clouds with their spreads."""
    figure = Figure(figsize=(9, 3), layout="constrained")
    for number in range(4):
        axes = figure.add_subplot(1, 4, number + 1, projection="3d")
        axes.scatter(*clouds[number].T, c=clouds[number][:, 2], cmap="viridis", depthshade=False)
        axes.set_title("{:.2f}, {:.2f}, {:.2f} m".format(*spreads[number]), fontsize=10)
        axes.set_aspect("equal")
        axes.set_xticklabels([]), axes.set_yticklabels([]), axes.set_zticklabels([])
    figure.savefig(path)


def main() -> None:
    asked = options(__doc__).parse_args()
    batches = 2 if asked.small else 50
    place = {"session_name": "generate", "session_dir": str(asked.session_dir)}

    alone = EnvironmentConfig(Cloud, as_tcp_ip_client=False, seed=0)
    generation = Timed(alone, batch_nb=batches, batch_size=100, **place)
    generation.execute()
    print(f"in this process: {generation.rate:6.0f} samples/s, into {generation.session.path}:")
    with Dataset.open(generation.session.path) as dataset:
        for name, field in dataset.fields("training").items():
            print(f"  {name:14}{dataset.num_samples('training')} x {field.shape} {field.unit}")
        rows = dataset["training"]
        print(f"  row 17: spread {rows['ground_truth'][17].round(3)} m")
        if asked.picture:
            draw(asked.picture, rows["input"][:4], rows["ground_truth"][:4])

    for clients in (1, 4):
        config = EnvironmentConfig(Cloud, {"delay": 0.005}, num_clients=clients, seed=0)
        generation = Timed(config, batch_nb=batches, batch_size=20, **place)
        generation.execute()
        who = f"{clients} client{'s' * (clients > 1)}:"
        print(f"{who:16} {generation.rate:6.0f} samples/s")
    with Dataset.open(generation.session.path) as dataset:
        print(f"instances that made the first rows: {dataset['training']['env_id'][:8]}")


if __name__ == "__main__":
    main()
