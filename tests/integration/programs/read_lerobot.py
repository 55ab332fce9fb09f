"""Loads a dataset with LeRobot and stores what it returns as npz: read_lerobot.py ROOT OUT."""

import sys

import numpy as np
import torch

for name in ("nms", "qnms"):
    # torchvision imports only if its compiled operators have names, and PyPI's need CUDA.
    torch.library.define(f"torchvision::{name}", "(Tensor a, Tensor b, float c) -> Tensor")

from lerobot.datasets.lerobot_dataset import LeRobotDataset  # noqa: E402

root, out = sys.argv[1:]
step = {"observation.state": [0, 1 / 50]}
dataset, ahead = (
    LeRobotDataset("a/b", root=root),
    LeRobotDataset("a/b", root, delta_timestamps=step),
)
frames = [dataset[place] for place in range(len(dataset))]
columns = {
    name: np.stack([frame[name].numpy() for frame in frames])
    for name in frames[0]
    if name != "task"
}
loader = torch.utils.data.DataLoader(dataset, batch_size=len(dataset))
for name, column in next(iter(loader)).items():
    assert name == "task" or np.array_equal(column.numpy(), columns[name]), name
np.savez(
    out,
    **columns,
    ahead=np.stack([ahead[place]["observation.state"].numpy() for place in range(len(ahead))]),
    lengths=np.array(dataset.meta.episodes["length"]),
    mean=dataset.meta.stats["observation.state"]["mean"],
    tasks=np.array([frame["task"] for frame in frames]),
)
