"""Where robot descriptions and the meshes that they name lie on this machine."""

from __future__ import annotations

import importlib.metadata
from collections.abc import Mapping
from pathlib import Path
from urllib.parse import unquote, urlparse
from xml.etree import ElementTree

from physx_core.errors import MissingMeshesError, ModelError

EXAMPLE_DATA = "example-robot-data"
"""Distribution with many robots, and the package that their mesh names begin with."""


def example_data_dir() -> Path | None:
    """Return the folder of the package ``example-robot-data``, None where it is not installed."""
    try:
        files = importlib.metadata.files(EXAMPLE_DATA) or []
    except importlib.metadata.PackageNotFoundError:
        return None
    marker = f"share/{EXAMPLE_DATA}/robots/"
    for file in files:
        if marker in file.as_posix():
            path = Path(str(file.locate())).as_posix()
            return Path(path[: path.rindex(marker)]) / "share" / EXAMPLE_DATA
    return None


def example_robot(name: str) -> Path:
    """Return the path of a robot of ``example-robot-data``.

    Args:
        name: Path below its folder ``robots``, as in ``"panda_description/urdf/panda.urdf"``.

    Raises:
        ModelError: The package is not installed, or has no such robot.
    """
    folder = example_data_dir()
    if folder is None:
        raise ModelError(
            f'The robot "{name}" comes with the package {EXAMPLE_DATA}, which is not installed. '
            'To install it: pip install "physx-dart[robots]"'
        )
    path = folder / "robots" / name
    if not path.is_file():
        raise ModelError(f"{EXAMPLE_DATA} in {folder} has no robot {name}.")
    return path


def check_meshes(
    model: Path, root: ElementTree.Element, package_dirs: Mapping[str, str | Path]
) -> None:
    """Check that all mesh files of a robot are there, those for drawing and for collisions.

    Args:
        model: Path of the robot's URDF file.
        root: Its root element.
        package_dirs: Folder of each package.

    Raises:
        MissingMeshesError: Some are not; it names all of them.
    """
    names = dict.fromkeys(mesh.get("filename", "") for mesh in root.iter("mesh"))
    missing = [name for name in names if not _exists(model, name, package_dirs)]
    if missing:
        raise MissingMeshesError(str(model), missing)


def _exists(model: Path, name: str, package_dirs: Mapping[str, str | Path]) -> bool:
    path = mesh_path(model, name, package_dirs)
    return path is not None and path.is_file()


def mesh_path(model: Path, name: str, package_dirs: Mapping[str, str | Path]) -> Path | None:
    """Return the file that a mesh name stands for, None where its package is not known.

    Args:
        model: Path of the robot's URDF file; relative names begin at its folder.
        name: The name as the URDF gives it: ``package://...``, ``file://...`` or a path.
        package_dirs: Folder of each package. Packages that are not in it are looked for among the
            folders around the URDF file, and ``example-robot-data`` where it is installed.
    """
    if name.startswith("package://"):
        package, _, rest = name.removeprefix("package://").partition("/")
        folder = _package_dir(model, package, package_dirs)
        return None if folder is None else folder / rest
    if name.startswith("file://"):
        return Path(unquote(urlparse(name).path))
    return model.parent / name


def _package_dir(model: Path, package: str, package_dirs: Mapping[str, str | Path]) -> Path | None:
    if package in package_dirs:
        return Path(package_dirs[package])
    for folder in model.parents:
        if folder.name == package:
            return folder
    return example_data_dir() if package == EXAMPLE_DATA else None
