"""The plugin ``formats``."""

from __future__ import annotations

from physx_core.plugins import Components, hookimpl


@hookimpl
def physx_formats() -> Components:
    """Return the formats; their libraries are imported when they are used."""
    return {
        "npz": "physx_formats.npz_format:FORMAT",
        "hdf5-single": "physx_formats.hdf5_format:FORMAT",
        "parquet": "physx_formats.parquet_format:FORMAT",
        "csv": "physx_formats.csv_format:FORMAT",
        "safetensors": "physx_formats.safetensors_format:FORMAT",
        "vtkhdf": "physx_formats.vtkhdf_format:FORMAT",
        "zarr": "physx_formats.zarr_format:FORMAT",
        "minari": "physx_formats.minari_format:FORMAT",
        "lerobot": "physx_formats.lerobot_format:FORMAT",
        "deepphysx": "physx_formats.deepphysx_format:FORMAT",
    }
