"""OtherPython: an interpreter other than this one, as one that runs clients needs it."""

from __future__ import annotations

import importlib.metadata
import importlib.util
import json
import os
import subprocess
from collections.abc import Mapping
from pathlib import Path

from physx_core.closeable import Closeable
from physx_core.errors import ConfigError
from physx_core.processes import TemporaryFolder

_LENT = ("physx_core", "lazy_loader", "pluggy")
"""Packages without compiled parts, which any interpreter can import; clients need these."""
_OLDEST = (3, 11)
_PATIENCE = 60.0
_ASK = """
import importlib.util, json, sys
names = [name for name in ("physx_core", "numpy") if importlib.util.find_spec(name)]
print(json.dumps([sys.version_info[:2], names]))
"""


class OtherPython(Closeable):
    """Another Python interpreter on this machine.

    If physx is not installed there, it borrows that of this interpreter: a folder with links to
    physx_core and to the pure Python packages that a client needs. NumPy must be there.

    Attributes:
        variables: Environment variables for its processes.
    """

    def __init__(self, python: str, variables: Mapping[str, str]) -> None:
        """Ask the interpreter what it has.

        Args:
            python: The interpreter: a path, or a name to look for in ``PATH``.
            variables: Environment variables for its processes.

        Raises:
            ConfigError: If it cannot be run, is too old, or has no NumPy.
        """
        self.variables = dict(variables)
        self._lent: TemporaryFolder | None = None
        version, found = _ask(python, variables)
        if tuple(version) < _OLDEST:
            raise ConfigError(
                f"launcher_kwargs: python: {python} is Python {'.'.join(map(str, version))}, but "
                f"clients need {'.'.join(map(str, _OLDEST))}. A script for an older one can be a "
                "program of external/program: see docs/external.md."
            )
        if "numpy" not in found:
            raise ConfigError(
                f"launcher_kwargs: python: {python} has no NumPy, which clients need:  {python} -m "
                "pip install numpy  (Debian: apt install python3-numpy)."
            )
        if "physx_core" not in found:
            self._lend()

    def close(self) -> None:
        """Remove what was lent."""
        if self._lent is not None:
            self._lent.close()

    def _lend(self) -> None:
        self._lent = TemporaryFolder("python-")
        for name in _LENT:
            spec = importlib.util.find_spec(name)
            assert spec is not None and spec.origin is not None
            (self._lent.path / name).symlink_to(Path(spec.origin).parent)
        # Its metadata, which say what plugins it has.
        metadata = _metadata_of("physx-core")
        (self._lent.path / metadata.name).symlink_to(metadata)
        later = self.variables.get("PYTHONPATH", os.environ.get("PYTHONPATH"))
        self.variables["PYTHONPATH"] = os.pathsep.join(filter(None, (str(self._lent.path), later)))


def _ask(python: str, variables: Mapping[str, str]) -> tuple[list[int], list[str]]:
    """Return an interpreter's version and which of the packages it has."""
    try:
        answer = subprocess.run(
            [python, "-c", _ASK],
            env={**os.environ, **variables, "PYTHONSAFEPATH": "1"},
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            timeout=_PATIENCE,
            check=True,
        )
        version, found = json.loads(answer.stdout)
    except (OSError, ValueError, subprocess.SubprocessError) as error:
        said = (getattr(error, "stderr", None) or str(error)).strip().splitlines()
        raise ConfigError(
            f"launcher_kwargs: python: {python} does not run as a Python interpreter: {said[-1]}"
        ) from None
    return version, found


def _metadata_of(name: str) -> Path:
    """Return the folder with the metadata of an installed distribution."""
    distribution = importlib.metadata.distribution(name)
    (file,) = (file for file in distribution.files or () if file.name == "METADATA")
    return Path(str(distribution.locate_file(file))).parent
