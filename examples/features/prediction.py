"""A trained network takes part in the running environment, and what it says is recorded.

    python examples/features/prediction.py [--rerun]

Prints how far the guesses are from the means of clouds that the network has never seen. With
--rerun, the session gets a file for the Rerun viewer, with clouds, means and guesses.
"""

from __future__ import annotations

import sys

from cloud import Cloud
from offline_training import train

from physx_core import Dataset, EnvironmentConfig, NetworkConfig, Prediction

STEPS = 100


def main() -> None:
    session = train(8, "prediction").session
    config = EnvironmentConfig(
        Cloud,
        as_tcp_ip_client=False,
        visualizer="rerun" if "--rerun" in sys.argv else None,
        seed=1,
    )
    Prediction(
        NetworkConfig(), config, session_name=session.name, step_nb=STEPS, record=True
    ).execute()
    with Dataset.open(session.path) as dataset:
        means = dataset["prediction"]["ground_truth"][:]
        guesses = dataset["prediction"]["prediction"][:]
    distance, still = Cloud.distance(guesses, means), Cloud.distance(0 * guesses, means)
    print(f"{STEPS} new clouds: guesses are {distance:.4f} m off the mean,")
    print(f"the origin would be {still:.4f} m off. Recorded in {session.path}")


if __name__ == "__main__":
    main()
