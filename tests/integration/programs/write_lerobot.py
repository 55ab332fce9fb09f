"""Records a dataset with LeRobot from what an npz has: write_lerobot.py ROWS.npz ROOT."""

import sys

import numpy as np
import torch

for name in ("nms", "qnms"):
    # torchvision imports only if its compiled operators have names, and PyPI's need CUDA.
    torch.library.define(f"torchvision::{name}", "(Tensor a, Tensor b, float c) -> Tensor")

from lerobot.datasets.lerobot_dataset import LeRobotDataset  # noqa: E402

source, root = sys.argv[1:]
with np.load(source) as rows:
    state, pictures, episode = rows["q"].astype("f4"), rows["camera"], rows["episode"]
images = {"shape": pictures.shape[1:], "names": ["height", "width", "channels"]}
features = {
    "observation.state": {"dtype": "float32", "shape": state.shape[1:], "names": None},
    "observation.images.video": {"dtype": "video", **images},
    "observation.images.png": {"dtype": "image", **images},
}
dataset = LeRobotDataset.create("a/b", fps=50, features=features, root=root, vcodec="h264")
for row, number in enumerate(episode):
    seen = {f"observation.images.{kind}": pictures[row] for kind in ("video", "png")}
    dataset.add_frame({"observation.state": state[row], **seen, "task": f"task {number}"})
    if row + 1 == len(episode) or episode[row + 1] != number:
        dataset.save_episode()
dataset.finalize()
