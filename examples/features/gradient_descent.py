"""An environment looks on while the network learns: it asks for predictions in its own step.

    python examples/features/gradient_descent.py

The cloud stays the same, so that each batch holds one sample again and again. Prints how the
network's guess comes closer to the mean with each step of gradient descent.
"""

from __future__ import annotations

from cloud import NETWORK, Cloud

from physx_core import EnvironmentConfig, Training

STEPS = 300


class Watched(Cloud):
    """A cloud that asks the network, as it is now, for the mean."""

    def step(self) -> None:
        super().step()
        guess = self.get_prediction(input=self.points)["prediction"]
        if self.step_index % 50 == 0:
            distance = self.distance(guess, self.mean)
            print(f"after {self.step_index:3} steps the guess is {distance:.4f} m off the mean")


def main() -> None:
    config = EnvironmentConfig(Watched, {"constant": True}, as_tcp_ip_client=False, seed=0)
    Training(
        NETWORK,
        None,
        config,
        session_name="gradient_descent",
        epoch_nb=1,
        batch_nb=STEPS + 1,
        batch_size=1,
        seed=0,
    ).execute()


if __name__ == "__main__":
    main()
