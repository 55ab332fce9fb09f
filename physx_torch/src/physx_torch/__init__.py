"""The physx plugin ``torch``: PyTorch networks, optimization and transformation.

The public names are imported when they are first used, so that finding the plugin does not import
torch.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from physx_core.openmp import rest_soon

if TYPE_CHECKING:
    from physx_torch.data import StoredDataset
    from physx_torch.forward_dynamics import ForwardDynamics
    from physx_torch.module_network import ModuleNetwork
    from physx_torch.network import TorchNetwork
    from physx_torch.networks.encoder_decoder import EncoderDecoder
    from physx_torch.networks.fc import FC
    from physx_torch.networks.unet import UNet
    from physx_torch.networks.unet_transformation import UNetTransformation
    from physx_torch.optimization import TorchOptimization
    from physx_torch.tensorboard import TensorBoard
    from physx_torch.transformation import TorchTransformation

__version__ = "0.1.0"

rest_soon()

_HOMES = {
    "EncoderDecoder": "networks.encoder_decoder",
    "FC": "networks.fc",
    "ForwardDynamics": "forward_dynamics",
    "ModuleNetwork": "module_network",
    "StoredDataset": "data",
    "TensorBoard": "tensorboard",
    "TorchNetwork": "network",
    "TorchOptimization": "optimization",
    "TorchTransformation": "transformation",
    "UNet": "networks.unet",
    "UNetTransformation": "networks.unet_transformation",
}

__all__ = [
    "FC",
    "EncoderDecoder",
    "ForwardDynamics",
    "ModuleNetwork",
    "StoredDataset",
    "TensorBoard",
    "TorchNetwork",
    "TorchOptimization",
    "TorchTransformation",
    "UNet",
    "UNetTransformation",
]


def __getattr__(name: str) -> Any:
    """Import a public name when it is first used."""
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(importlib.import_module(f"physx_torch.{_HOMES[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    """Return the public names."""
    return sorted([*globals(), *__all__])
