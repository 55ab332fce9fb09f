"""A network learns from an existing dataset; no environment runs.

    python examples/features/offline_training.py [--rerun]

Prints the loss at the end, and that the dataset's own session is only read. With --rerun, the
session gets a file for the Rerun viewer, with curves, histograms and predictions.
"""

from __future__ import annotations

import sys

from cloud import NETWORK
from single_environment import generate

from physx_core import DatasetConfig, Training


def train(epochs: int, session_name: str) -> Training:
    """Train with stored samples, a tenth of which is held back, and return the training."""
    training = Training(
        NETWORK,
        DatasetConfig(existing_dir=generate(3000, "cloud_samples"), validation_split=0.1),
        session_name=session_name,
        epoch_nb=epochs,
        batch_size=32,
        seed=0,
        statistics=["rerun"] if "--rerun" in sys.argv else [],
        histograms_every=1,
    )
    training.execute()
    return training


def main() -> None:
    training = train(8, "offline_training")
    print(f"Mean squared error in m2: {training.training_loss:.5f} with the samples learned,")
    print(f"                          {training.validation_loss:.5f} with those held back.")
    print(f"The network is in {training.session.path}, the samples stay where they were.")


if __name__ == "__main__":
    main()
