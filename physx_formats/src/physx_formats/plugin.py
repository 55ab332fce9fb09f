"""The plugin ``formats``."""

from __future__ import annotations

from physx_core.plugins import Components, hookimpl


@hookimpl
def physx_formats() -> Components:
    """Return the formats; their libraries are imported when they are used."""
    return {
        "npz": "physx_formats.files.npz:FORMAT",
        "hdf5-single": "physx_formats.files.hdf5:FORMAT",
        "parquet": "physx_formats.files.parquet:FORMAT",
        "csv": "physx_formats.files.csv:FORMAT",
        "safetensors": "physx_formats.files.safetensors:FORMAT",
        "vtkhdf": "physx_formats.files.vtkhdf:FORMAT",
        "zarr": "physx_formats.files.zarr:FORMAT",
        "minari": "physx_formats.files.minari:FORMAT",
        "lerobot": "physx_formats.files.lerobot.format:FORMAT",
        "mcap": "physx_formats.files.mcap:FORMAT",
        "deepphysx": "physx_formats.files.deepphysx:FORMAT",
    }
