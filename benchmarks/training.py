"""Training against the same network in a plain torch loop over tensors in RAM, one thread.

Claim: physx, which reads its batches from the stored dataset, normalization aside, trains at least
0.9 times as many batches per second; and with statistics to CSV and TensorBoard, at least 0.9 times
as many as without. Before each step, physx also checks that the gradients are finite, which the
plain loop does not. Printed for comparison are a run without this check (`on_nan="continue"`), and
a careful plain loop, which checks the gradients and gathers its batches from NumPy's arrays.

    python benchmarks/training.py --device cuda    # both on a GPU, to which each batch is copied
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import torch
from measure import device, finish, rates, report

from physx_core import Dataset, DatasetConfig, NetworkConfig, Training, View
from physx_core.observers import Observers, ProgressBar
from physx_torch import FC

BATCH, ROUNDS = 16, 7
CASES = {
    "small: (5,) -> (1,), FC [5, 5, 5, 1]": ([5, 5, 5, 1], (5,), (1,), 2000, 400),
    "medium: (1000, 3) -> (3,), FC [3000, 64, 3]": ([3000, 64, 3], (1000, 3), (3,), 512, 160),
}


def plain_loop(
    layers: list[int], x: np.ndarray, y: np.ndarray, batches: int, *, careful: bool = False
) -> Callable[[], int]:
    """Return a round of training without physx; a careful one checks the gradients of each step."""
    place = device()
    network = FC(layers, net_fields="input", opt_fields="ground_truth").to(place)
    inputs = torch.from_numpy(x.astype(np.float32)).reshape(len(x), -1)
    targets = torch.from_numpy(y.astype(np.float32))
    stack, loss_function = network.layers, torch.nn.MSELoss()
    optimizer = torch.optim.Adam(network.parameters(), lr=1e-3)
    arrays = inputs.numpy(), targets.numpy()
    learned = list(network.parameters())

    def step(loss: torch.Tensor) -> None:
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        if careful:
            gradients = [p.grad for p in learned if p.grad is not None]
            torch.nn.utils.get_total_norm(gradients, error_if_nonfinite=True)
        optimizer.step()
        loss.item()

    def train() -> int:
        order = torch.randperm(len(inputs))
        for number in range(batches):
            first = number * BATCH % (len(order) - BATCH + 1)
            chosen = order[first : first + BATCH]
            if careful:
                taken = [torch.from_numpy(array[chosen.numpy()]).to(place) for array in arrays]
            else:
                taken = [inputs[chosen].to(place), targets[chosen].to(place)]
            step(loss_function(stack(taken[0]), taken[1]))
        return batches

    return train


def epochs(training: Training) -> Callable[[], int]:
    """Return a round of training with physx: an epoch of an open pipeline."""

    def epoch() -> int:
        training.epoch_begin()
        while training.batch_condition():
            training.batch_begin()
            training.batch_produce()
            training.optimize()
            training.batch_count()
            training.batch_end()
        trained = training.batch_id
        training.epoch_count()
        training.epoch_end()
        return trained

    training.train_begin()
    return epoch


def with_and_without_statistics(title: str, training: Callable[..., Training]) -> bool:
    """Measure the cost of writing all numbers to CSV and TensorBoard; return if it is small."""
    with training() as silent, training(statistics="torch/tensorboard") as told:
        silent.observers.close()
        silent.observers = Observers([ProgressBar()])
        candidates = {"without statistics": epochs(silent), "CSV and TensorBoard": epochs(told)}
        measured = rates(candidates, ROUNDS)
    return report(
        f"Statistics, {title}",
        "batches",
        measured,
        "without statistics",
        0.9,
        "CSV and TensorBoard",
    )


def main() -> None:
    """Measure and print."""
    torch.set_num_threads(1)
    rng = np.random.default_rng(0)
    met = []
    with tempfile.TemporaryDirectory() as name:
        for number, (title, (layers, ins, outs, rows, batches)) in enumerate(CASES.items()):
            x, y = rng.random((rows, *ins)), rng.random((rows, *outs))
            folder = Path(name) / f"data_{number}"
            with Dataset.create(folder) as dataset:
                dataset.append("training", {"input": x, "ground_truth": y})
            network = NetworkConfig(
                "torch/fc",
                network_kwargs={"layers": layers, "opt_fields": "ground_truth"},
                loss="MSELoss",
                optimizer="Adam",
                lr=1e-3,
                device=device(),
            )
            training = partial(
                Training,
                network,
                DatasetConfig(existing_dir=str(folder), view=View(hold_back=False)),
                session_dir=name,
                epoch_nb=ROUNDS + 1,
                batch_nb=batches,
                batch_size=BATCH,
            )
            with training() as opened, training(on_nan="continue") as careless:
                candidates = {
                    "plain torch loop": plain_loop(layers, x, y, batches),
                    "careful plain loop": plain_loop(layers, x, y, batches, careful=True),
                    "physx": epochs(opened),
                    'physx, on_nan="continue"': epochs(careless),
                }
                measured = rates(candidates, ROUNDS)
            met.append(
                report(f"Training, {title}", "batches", measured, "plain torch loop", 0.9, "physx")
            )
            met.append(with_and_without_statistics(title, training))
    finish(met)


if __name__ == "__main__":
    main()
