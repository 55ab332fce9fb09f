"""Trains LeRobot's own policies for a step: train_lerobot.py ROOT."""

import sys

import torch

for name in ("nms", "qnms"):
    # torchvision imports only if its compiled operators have names, and PyPI's need CUDA.
    torch.library.define(f"torchvision::{name}", "(Tensor a, Tensor b, float c) -> Tensor")

from lerobot.configs.types import FeatureType  # noqa: E402
from lerobot.datasets.factory import resolve_delta_timestamps  # noqa: E402
from lerobot.datasets.lerobot_dataset import LeRobotDataset  # noqa: E402
from lerobot.datasets.utils import dataset_to_policy_features  # noqa: E402
from lerobot.policies.act.configuration_act import ACTConfig  # noqa: E402
from lerobot.policies.act.modeling_act import ACTPolicy  # noqa: E402
from lerobot.policies.act.processor_act import make_act_pre_post_processors  # noqa: E402
from lerobot.policies.diffusion.configuration_diffusion import DiffusionConfig  # noqa: E402
from lerobot.policies.diffusion.modeling_diffusion import DiffusionPolicy  # noqa: E402
from lerobot.policies.diffusion.processor_diffusion import (  # noqa: E402
    make_diffusion_pre_post_processors,
)

(root,) = sys.argv[1:]
whole = LeRobotDataset("a/b", root=root)
found = dataset_to_policy_features(whole.meta.features)
outputs = {name: of for name, of in found.items() if of.type is FeatureType.ACTION}
inputs = {name: of for name, of in found.items() if name not in outputs}
inputs = {name: of for name, of in inputs.items() if name.startswith("observation.")}
both = {"input_features": inputs, "output_features": outputs, "device": "cpu"}
act = ACTConfig(chunk_size=4, n_action_steps=4, dim_model=32, n_heads=2, dim_feedforward=32, **both)
diffusion = DiffusionConfig(horizon=8, n_action_steps=4, down_dims=(16, 32), n_groups=4, **both)
for make, process_by, config in (
    (ACTPolicy, make_act_pre_post_processors, act),
    (DiffusionPolicy, make_diffusion_pre_post_processors, diffusion),
):
    policy = make(config)
    process, _ = process_by(config, dataset_stats=whole.meta.stats)
    steps = resolve_delta_timestamps(config, whole.meta)
    dataset = LeRobotDataset("a/b", root=root, delta_timestamps=steps)
    batch = process(next(iter(torch.utils.data.DataLoader(dataset, batch_size=8, shuffle=True))))
    loss, _ = policy.forward(batch)
    loss.backward()
    assert torch.isfinite(loss), loss
    print(config.type, {name: tuple(of.shape) for name, of in inputs.items()})
