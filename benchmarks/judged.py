"""What it costs to say how good a network is, and whether what is said of planted truths is right.

A training lasts a minute (``--seconds``). The time that it takes at its end to measure the
network's errors, fit the rivals, and compare them is a share of that. The planted networks are
exactly the mean, the linear map, the nearest sample, or the truth with a known error; some are
trained on rows whose held-back part cannot judge anything.

    python benchmarks/judged.py --check

Claims: at most a tenth of the training; nothing with ``rivals="none"``; all planted truths named;
the page of a training on 5 fields with 10,000 validation rows, with a film of 40 pictures, within
30 s, of 5 MB at most, and the same bytes twice. The film needs a Vulkan driver.
"""

from __future__ import annotations

import argparse
import base64
import io
import os
import re
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from measure import claim, finish
from PIL import Image

from physx_core import (
    DataGeneration,
    Dataset,
    DatasetConfig,
    Environment,
    EnvironmentConfig,
    Field,
    NetworkConfig,
    Optimization,
    Parameter,
    Result,
    Training,
    View,
)
from physx_core.pipelines.learning.judging import Judging
from physx_core.toy import Linear
from physx_report import write_report

CASES = {
    "200 episodes of 500 rows, (12,) -> (12,), FC of 64": (100_000, 500, 12, [12, 64, 64, 12]),
    "200 episodes of 10 rows, (4096,) -> (4096,), FC of 64": (2_000, 10, 4096, [4096, 64, 4096]),
}
RNG = np.random.default_rng(0)
MAP = RNG.normal(size=(3, 2))


def store(folder: str, rows: dict[str, np.ndarray], length: int) -> str:
    """Store rows as episodes of some length; 0: nothing is known of episodes."""
    if length:
        number, step = np.divmod(np.arange(len(rows["x"])), length)
        rows = {**rows, "episode": number, "step": step}
    with Dataset.create(folder) as dataset:
        dataset.append("training", rows)
    return folder


# Costs ------------------------------------------------------------------------------------------


class Timed(Training):
    """Trains for some time."""

    until: float = 0.0

    def batch_condition(self) -> bool:
        """Return whether there is time left, or this is the first batch of an epoch."""
        return super().batch_condition() and (self.batch_id == 0 or time.monotonic() < self.until)

    def epoch_condition(self) -> bool:
        """Return whether there is time left."""
        return time.monotonic() < self.until


def cost(case: str, seconds: float, rivals: str) -> tuple[float, int, Result]:
    """Return the judgment's share of the training's time, how often there was one, the result."""
    rows, length, width, layers = CASES[case]
    x = RNG.normal(size=(rows, width)).astype(np.float32)
    data = store("data", {"x": x, "y": np.sin(x)}, length)
    network = NetworkConfig(
        "torch/fc",
        network_kwargs={"layers": layers, "net_fields": "x", "opt_fields": "y"},
        loss="MSELoss",
        optimizer="Adam",
        lr=1e-3,
    )
    spent: list[float] = []
    judge = Judging.judge

    def timed(*arguments: Any) -> Any:
        begin = time.monotonic()
        found = judge(*arguments)
        spent.append(time.monotonic() - begin)
        return found

    Judging.judge = timed  # type: ignore[method-assign]
    training = Timed(network, data, epoch_nb=10**6, batch_size=64, rivals=rivals, quiet=True)
    with training:
        begin = time.monotonic()
        training.until = begin + seconds
        found = training.execute()
        share = sum(spent) / (time.monotonic() - begin - sum(spent))
    Judging.judge = judge  # type: ignore[method-assign]
    return share, len(spent), found


# Planted truths ---------------------------------------------------------------------------------


class Nothing(Optimization):
    """Learns nothing."""

    def set_optimizer(self, optimizer: Any, network: Any, **kwargs: Any) -> None:
        """Keep the network."""
        self.network = network

    def compute_loss(self, batch: Any) -> float:
        """Return a number."""
        return 1.0

    def optimize(self, loss: Any) -> None:
        """Do nothing."""


class Planted(Linear):
    """Predicts what a function of the inputs returns."""

    default_optimization = Nothing
    answer: Callable[[np.ndarray], np.ndarray]

    def __init__(self) -> None:
        super().__init__("x", "y")

    def predict(self, data: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Return the planted prediction."""
        return {"y": type(self).answer(data["x"])}


def verdicts(
    answer: Callable[[np.ndarray], np.ndarray], rows: dict[str, np.ndarray], length: int
) -> dict[str, str]:
    """Return what is said of a planted network, by rival."""
    with tempfile.TemporaryDirectory(dir=".") as folder:
        network = NetworkConfig(
            type("Chosen", (Planted,), {"answer": staticmethod(answer)}), data_type="float64"
        )
        data = DatasetConfig(existing_dir=store(f"{folder}/data", rows, length), view=View())
        training = Training(
            network, data, epoch_nb=1, batch_nb=1, batch_size=50, session_dir=folder, quiet=True,
            validation_every=0,
        )  # fmt: skip
        of = training.execute().parts["validation"].fields["y"]
    return {name: rival.verdict if rival.errors else "" for name, rival in of.rivals.items()}


def look_up(known: np.ndarray, values: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
    """Return a network that answers with the value of the nearest known row."""

    def answer(x: np.ndarray) -> np.ndarray:
        return values[np.square(x[:, None] - known).sum(axis=2).argmin(axis=1)]

    return answer


def toward(right: Callable[[np.ndarray], np.ndarray], wrong: np.ndarray, share: float) -> Any:
    """Return a network that is off by a share of the difference of a constant and the truth."""
    return lambda x: right(x) + share * (wrong - right(x))


def planted() -> Iterator[tuple[str, bool]]:
    """Yield each planted truth, and whether it was named."""
    x = RNG.normal(size=(2000, 3))
    linear = {"x": x, "y": x @ MAP + 0.3 * RNG.normal(size=(2000, 2))}
    curved = {"x": x, "y": np.sin(3 * x[:, :2])}
    exact = {"x": x, "y": np.sin(x[:, :2])}
    phase = np.linspace(0, 40, 2000)
    orbit = np.stack([np.sin(phase), np.cos(phase), np.sin(3 * phase)], axis=1)
    one = {"x": orbit, "y": np.sin(2 * orbit[:, :2])}
    mean = linear["y"].mean(axis=0)
    held = np.array([name == "validation" for name in parts(linear)])

    found = verdicts(lambda x: np.broadcast_to(mean, (len(x), 2)), linear, 20)
    yield "the mean is no better than the mean", found["mean"] == "even"
    yield "the mean loses to the linear map", found["linear map"] == "loses"
    found = verdicts(lambda x: x @ MAP, linear, 20)
    yield "the linear map is no better than itself", found["linear map"] == "even"
    yield "the linear map beats the mean", found["mean"] == "wins"
    found = verdicts(look_up(x[~held], curved["y"][~held]), curved, 20)
    yield "a lookup is no better than the nearest sample", found["nearest neighbor"] == "even"
    found = verdicts(lambda x: np.sin(3 * x[:, :2]), curved, 20)
    yield (
        "the truth beats all",
        {found[n] for n in ("mean", "linear map", "nearest neighbor")} == {"wins"},
    )
    found = verdicts(lambda x: np.sin(2 * x[:, :2]), one, 2000)
    yield "rows of one trajectory say nothing", set(found.values()) == {"unknown", ""}
    found = verdicts(lambda x: np.sin(2 * x[:, :2]), one, 0)
    yield "nor do they if it is not known that they are", set(found.values()) == {"unknown", ""}
    zero = exact["y"].mean(axis=0)
    right = lambda x: np.sin(x[:, :2])  # noqa: E731
    found = verdicts(toward(right, zero, 0.97), {n: v[:600] for n, v in exact.items()}, 20)
    yield "better by a little on 6 episodes is too few to say", found["mean"] == "unknown"
    found = verdicts(toward(right, zero, 0.97), exact, 20)
    yield "the same on 20 episodes is better", found["mean"] == "wins"


def parts(rows: dict[str, np.ndarray]) -> list[str]:
    """Return the part of each row."""
    with tempfile.TemporaryDirectory(dir=".") as folder:
        data = store(f"{folder}/data", rows, 20)
        named = ["training"] * len(rows["x"])
        with View().open(50, data=data, part="validation") as held:
            for number in range(len(held)):
                for row in held.rows(number)[0]:
                    named[row] = "validation"
    return named


# The page -------------------------------------------------------------------------------------


class Waves(Environment):
    """A mesh that moves as a field says, and four fields more."""

    episode_steps = 100

    def create(self) -> None:
        """Lay out the mesh."""
        place = np.arange(100).reshape(10, 10)
        self.rest = np.stack([*np.divmod(np.arange(100), 10), np.zeros(100)], axis=1) / 10
        corners = place[:-1, :-1], place[1:, :-1], place[:-1, 1:]
        self.cells = np.stack([each.ravel() for each in corners], axis=1)
        self.define_parameters([Parameter("speed", 0.1, 0.3)])

    def init_database(self) -> None:
        """Define the input and the fields."""
        self.define_training_fields([Field("x", (4,)), *(Field(n, s) for n, s in SHAPES.items())])

    def init_visualization(self) -> None:
        """Draw the mesh."""
        self.factory.add_mesh("waves", self.rest, self.cells)

    def reset_parameters(self, speed: float) -> None:
        """Begin anywhere."""
        self.speed, self.phase = speed, self.rng.uniform(0.0, 6.0, 4)

    def step(self) -> None:
        """Move on."""
        self.phase = self.phase + self.speed
        x = np.sin(self.phase)
        fields = {name: x[0] * np.ones(shape) for name, shape in SHAPES.items()}
        fields["e"] = self.rest + np.sin(4 * self.rest[:, :1] + self.phase[1]) * [0, 0, 0.1]
        self.set_training_data(x=x, **fields)
        self.factory.update_mesh("waves", positions=fields["e"])


SHAPES: dict[str, tuple[int, ...]] = {
    "a": (), "b": (3,), "c": (20,), "d": (16, 16), "e": (100, 3),
}  # fmt: skip


def pages() -> list[bool]:
    """Write the page of a training twice."""
    environment = EnvironmentConfig(f"{Path(__file__)}:Waves", seed=0, as_tcp_ip_client=False)
    with DataGeneration(environment, episodes=500, quiet=True) as generation:
        generation.execute()
    options = {"layers": [4, 64, 580], "net_fields": "x", "opt_fields": list(SHAPES)}
    network = NetworkConfig("torch/fc", options, loss="MSELoss", optimizer="Adam", lr=1e-3)
    data = str(generation.session.path)
    training = Training(network, data, epoch_nb=1, batch_size=500, rivals="all", quiet=True)
    judged = training.execute().parts["validation"]
    begin = time.monotonic()
    first_page = write_report(training.session.path, trust=True).read_bytes()
    seconds = time.monotonic() - begin
    again = write_report(training.session.path, trust=True).read_bytes()
    films = re.findall(rb"image/webp;base64,([^\"]+)", first_page)
    pictures = [Image.open(io.BytesIO(base64.b64decode(each))).n_frames for each in films]
    return [
        claim(f"seconds to the page of {judged.samples:,} rows", seconds, at_most=30.0),
        claim("MB of the page", len(first_page) / 1e6, at_most=5.0),
        claim("bytes that differ in a second page", int(first_page != again), at_most=0),
        claim("pictures of its film", max(pictures, default=0), at_least=40),
    ]


def main() -> None:
    """Measure, and print whether the claims hold."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--seconds", type=float, default=60.0)
    seconds = parser.parse_known_args()[0].seconds
    met = []
    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)
        for case in CASES:
            with tempfile.TemporaryDirectory(dir=".") as place:
                os.chdir(place)
                share, _, found = cost(case, seconds, "all")
                print(f"{case}\n{found}")
                met.append(claim(f"share of {seconds:g} s of training", share, at_most=0.1))
                os.chdir(folder)
        with tempfile.TemporaryDirectory(dir=".") as place:
            os.chdir(place)
            _, calls, _ = cost(next(iter(CASES)), 1.0, "none")
            met.append(claim('judgments with rivals="none"', calls, at_most=0))
            os.chdir(folder)
        with tempfile.TemporaryDirectory(dir=".") as place:
            os.chdir(place)
            met += pages()
            os.chdir(folder)
        named = list(planted())
        os.chdir("/")
    for truth, is_named in named:
        print(f"  {'named' if is_named else 'MISSED'}: {truth}")
    met.append(claim("planted truths", sum(right for _, right in named), at_least=len(named)))
    finish(met)


if __name__ == "__main__":
    main()
