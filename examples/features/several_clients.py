"""Environments in several client processes make samples together, over TCP.

    python examples/features/several_clients.py

Each step lasts 5 ms, so that one process cannot make more than 200 samples a second. Prints how
many one client and four clients make, and that a row tells which instance made it: row r of n
instances is always that of instance r modulo n, whatever their speed.
"""

from __future__ import annotations

import time

from cloud import Cloud

from physx_core import DataGeneration, Dataset, EnvironmentConfig

BATCHES, SIZE = 10, 40


class Timed(DataGeneration):
    """Measures the time from the first batch to the last; starting the clients does not count."""

    def data_generation_begin(self) -> None:
        super().data_generation_begin()
        self.begin = time.perf_counter()

    def data_generation_end(self) -> None:
        self.rate = BATCHES * SIZE / (time.perf_counter() - self.begin)
        super().data_generation_end()


def main() -> None:
    for clients in (1, 4):
        config = EnvironmentConfig(Cloud, {"delay": 0.005}, num_clients=clients, seed=0)
        generation = Timed(
            config, session_name="several_clients", batch_nb=BATCHES, batch_size=SIZE
        )
        generation.execute()
        print(f"{clients} client(s): {generation.rate:.0f} samples/s")
    with Dataset.open(generation.session.path) as dataset:
        print("Instances that made the first rows:", dataset["training"]["env_id"][:8])


if __name__ == "__main__":
    main()
