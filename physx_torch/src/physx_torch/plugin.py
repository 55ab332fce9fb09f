"""Hooks of the plugin ``torch``; components are references, imported on use."""

from __future__ import annotations

from physx_core.plugins import hookimpl


@hookimpl
def physx_networks() -> dict[str, str]:
    """Return the networks by name."""
    return {
        "fc": "physx_torch.networks.fc:FC",
        "encoder_decoder": "physx_torch.networks.encoder_decoder:EncoderDecoder",
        "graph": "physx_torch.networks.graph:GraphNetwork",
        "module": "physx_torch.networks.module_network:ModuleNetwork",
        "padded": "physx_torch.networks.padded:PaddedNetwork",
        "unet": "physx_torch.networks.unet:UNet",
    }


@hookimpl
def physx_optimizations() -> dict[str, str]:
    """Return the optimizations by name."""
    return {"default": "physx_torch.training.optimization:TorchOptimization"}


@hookimpl
def physx_transformations() -> dict[str, str]:
    """Return the transformations by name."""
    return {
        "default": "physx_torch.networks.transformation:TorchTransformation",
        "unet": "physx_torch.networks.unet_transformation:UNetTransformation",
    }


@hookimpl
def physx_visualizers() -> dict[str, str]:
    """Return the observers by name."""
    return {
        "tensorboard": "physx_torch.training.tensorboard:TensorBoard",
        "wandb": "physx_torch.training.wandb:WandB",
    }
