"""A network learns from samples that two clients make while it learns.

    python examples/features/online_training.py

With always_produce every batch is new; without it, the samples of the first epoch are stored and
used again. Prints the loss and the number of stored samples of both ways.
"""

from __future__ import annotations

from cloud import NETWORK, Cloud

from physx_core import EnvironmentConfig, Training


class Told(Training):
    """Prints the mean loss of some epochs."""

    def epoch_end(self) -> None:
        super().epoch_end()
        if self.epoch_id % 2 == 1:
            print(f"  epoch {self.epoch_id:2}: loss {self.training_loss:.5f} m2")


def main() -> None:
    for always in (False, True):
        config = EnvironmentConfig(Cloud, num_clients=2, always_produce=always, seed=0)
        training = Told(
            NETWORK,
            None,
            config,
            session_name="online_training",
            epoch_nb=7,
            batch_nb=20,
            batch_size=32,
            seed=0,
        )
        print("New samples in every epoch:" if always else "New samples in the first epoch:")
        with training:
            training.execute()
            print(f"  stored: {training.data.dataset.num_samples('training')} samples")


if __name__ == "__main__":
    main()
