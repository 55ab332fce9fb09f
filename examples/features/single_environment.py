"""One environment in this process makes samples, and the dataset keeps them.

    python examples/features/single_environment.py

Prints how many samples were made in a second, and what the dataset holds.
"""

from __future__ import annotations

import time

from cloud import Cloud

from physx_core import DataGeneration, Dataset, EnvironmentConfig


def generate(samples: int, session_name: str) -> str:
    """Make samples and return their session's folder."""
    generation = DataGeneration(
        EnvironmentConfig(Cloud, as_tcp_ip_client=False, seed=0),
        session_name=session_name,
        batch_nb=samples // 100,
        batch_size=100,
    )
    generation.execute()
    return str(generation.session.path)


def main() -> None:
    begin = time.perf_counter()
    session = generate(5000, "single_environment")
    print(f"{5000 / (time.perf_counter() - begin):.0f} samples/s in {session}:")
    with Dataset.open(session) as dataset:
        for name, field in dataset.fields("training").items():
            print(f"  {name:14}{dataset.num_samples('training')} x {field.shape} {field.unit}")
        rows = dataset["training"]
        print("Row 17: mean of the points", rows["input"][17].mean(axis=0))
        print("        ground truth      ", rows["ground_truth"][17])


if __name__ == "__main__":
    main()
