"""A network's predictions inside a running environment.

First, an environment watches the network learn: it asks for predictions in its own step, as often
as it likes. Then a network trained on stored samples predicts the spread of clouds that it has
never seen. The environment draws the prediction over the truth, the viewer records the scene, and
the dataset records the predictions.

    python examples/03_predict.py
    physx view sessions/predict
"""

from __future__ import annotations

import numpy as np
from common import generate, options
from environments.cloud import Cloud, network

from physx_core import (
    Dataset,
    DatasetConfig,
    EnvironmentConfig,
    NetworkConfig,
    Prediction,
    Training,
)
from physx_rerun import render_picture


class Watched(Cloud):
    """A constant cloud that asks the network for its spread while the network learns."""

    def step(self) -> None:
        super().step()
        guess = self.get_prediction(input=self.points)["prediction"]
        if self.step_index % 50 == 0:
            distance = np.linalg.norm(guess - self.spread)
            print(f"  after {self.step_index:3} steps the guess is {distance:.4f} m off")


def main() -> None:
    asked = options(__doc__).parse_args()
    rows, epochs, steps = (500, 4, 10) if asked.small else (20_000, 12, 100)
    place = {"session_dir": str(asked.session_dir)}

    print("One cloud, again and again:")
    watched = EnvironmentConfig(Watched, {"constant": True}, as_tcp_ip_client=False, seed=0)
    once = {"epoch_nb": 1, "batch_nb": 201, "batch_size": 1, "seed": 0}
    Training(network(), None, watched, session_name="watch", **once, **place).execute()

    stored = DatasetConfig(
        existing_dir=str(generate(Cloud, rows, asked.session_dir, num_clients=2))
    )
    training = Training(
        network(), stored, session_name="predict", epoch_nb=epochs, batch_size=64, seed=0, **place
    )
    training.execute()
    session = training.session

    config = EnvironmentConfig(
        Cloud, num_clients=2, as_tcp_ip_client=False, visualizer="rerun", seed=1
    )
    taking_part = Prediction(
        NetworkConfig(), config, session_name=session.name, step_nb=steps, record=True, **place
    )
    taking_part.execute()
    with Dataset.open(session.path) as dataset:
        recorded = dataset["prediction"]
        right, guesses = recorded["ground_truth"][:], recorded["prediction"][:]
    far, same = (np.linalg.norm(g - right, axis=1).mean() for g in (guesses, right.mean(axis=0)))
    print(f"{len(right)} new clouds:\n  the network is {far:.4f} m off,")
    print(f"  always the same spread {same:.4f} m")
    if asked.picture:
        [recording] = session.path.glob("*.rrd")
        render_picture(recording, asked.picture, (900, 360))


if __name__ == "__main__":
    main()
