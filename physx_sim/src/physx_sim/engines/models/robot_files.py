"""Lookup of robot descriptions and the meshes they refer to."""

from __future__ import annotations

import importlib.metadata
from collections.abc import Mapping, Sequence
from pathlib import Path
from xml.etree.ElementTree import Element

from physx_core.errors import nearest
from physx_core.origin import install_hint
from physx_sim.errors import ModelError
from physx_sim.urdf import mesh_path as find_mesh

EXAMPLE_DATA = "example-robot-data"
"""Distribution with many robots; also the package name at the start of their mesh names."""
OWN_ROBOTS = Path(__file__).parents[1] / "robots"
"""Folder with physx's own robots."""


def find_robot(urdf: str | Path) -> Path:
    """Return the URDF file of a robot.

    Args:
        urdf: A path, or the name of a robot of physx, such as ``"cartpole"``, or of
            ``example-robot-data``, such as ``"a1/a1"``; ``physx robots`` lists the names.

    Raises:
        ModelError: If there is no such file or robot. A `Path`, or a name that ends in ``.urdf``,
            is not checked.
    """
    path = Path(urdf).absolute()
    if isinstance(urdf, Path) or urdf.lower().endswith(".urdf") or path.is_file():
        return path
    found = robot_path(urdf)
    if found is None:
        raise ModelError(
            f'There is no URDF file {path}, and no robot has the name "{urdf}".'
            f"{nearest(urdf, named_robots())} The command  physx robots  lists their names."
        )
    return found


def robot_path(name: str) -> Path | None:
    """Return the URDF file of a named robot, or None if there is none."""
    own = OWN_ROBOTS / f"{name}.urdf"
    if own.is_file() and "/" not in name:
        return own
    family, _, rest = name.partition("/")
    return _installed(family).get(name) if rest else None


def named_robots() -> dict[str, Path]:
    """Return the files of all named robots: those of physx, then installed ones."""
    own = {path.stem: path for path in sorted(OWN_ROBOTS.glob("*.urdf"))}
    return own | _installed()


def _installed(wanted: str | None = None) -> dict[str, Path]:
    """Return the files of installed robots by name, of one family or of all."""
    folder = example_data_dir()
    found: dict[str, Path] = {}
    for root in sorted((folder / "robots").iterdir()) if folder is not None else ():
        family = root.name.removesuffix("_description")
        if wanted in (None, family):
            found |= {f"{family}/{path.stem}": path for path in sorted(root.glob("**/*.urdf"))}
    return found


def example_data_dir() -> Path | None:
    """Return the folder of the package ``example-robot-data``, or None if it is not installed."""
    try:
        distribution = importlib.metadata.distribution(EXAMPLE_DATA)
    except importlib.metadata.PackageNotFoundError:
        return None
    usual = Path(str(distribution.locate_file(f"cmeel.prefix/share/{EXAMPLE_DATA}")))
    if (usual / "robots").is_dir():
        return usual
    marker = f"share/{EXAMPLE_DATA}/robots/"
    for file in distribution.files or []:
        if marker in file.as_posix():
            path = Path(str(file.locate())).as_posix()
            return Path(path[: path.rindex(marker)]) / "share" / EXAMPLE_DATA
    return None


def example_robot(name: str) -> Path:
    """Return the path of a robot of ``example-robot-data``.

    Args:
        name: Path in its folder ``robots``, such as ``"panda_description/urdf/panda.urdf"``.

    Raises:
        ModelError: If the package is not installed, or has no such robot.
    """
    folder = example_data_dir()
    if folder is None:
        raise ModelError(
            f'The robot "{name}" comes with the package {EXAMPLE_DATA}, which is not installed. '
            f"{install_hint('physx-sim', 'robots')}"
        )
    path = folder / "robots" / name
    if not path.is_file():
        raise ModelError(f"{EXAMPLE_DATA} in {folder} has no robot {name}.")
    return path


def missing_meshes(
    model: Path, elements: Sequence[Element], package_dirs: Mapping[str, str | Path]
) -> list[str]:
    """Return the mesh files of elements that do not exist, as named in the file.

    Args:
        model: Path of the robot's URDF file.
        elements: Elements that contain meshes.
        package_dirs: Folder of each package.
    """
    meshes = (mesh.get("filename", "") for each in elements for mesh in each.iter("mesh"))
    paths = {name: mesh_path(model, name, package_dirs) for name in dict.fromkeys(meshes)}
    return [name for name, path in paths.items() if path is None or not path.is_file()]


def mesh_path(model: Path, name: str, package_dirs: Mapping[str, str | Path]) -> Path | None:
    """Return the file that a mesh name refers to, or None if its package is not found.

    Like `physx_sim.mesh_path`, but also finds ``example-robot-data``.
    """
    found = find_mesh(model, name, package_dirs)
    if found is None and name.startswith(f"package://{EXAMPLE_DATA}/"):
        folder = example_data_dir()
        found = folder and folder / name.removeprefix(f"package://{EXAMPLE_DATA}/")
    return found
