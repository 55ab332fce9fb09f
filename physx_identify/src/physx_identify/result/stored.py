"""Identifications in files: plain TOML, which training reads, and a session's, for its report."""

from __future__ import annotations

from pathlib import Path

from physx_core.results import read_finding, store_finding, write_finding
from physx_identify.errors import IdentificationError
from physx_identify.result.identification import Identification

FILE = "identification.toml"


def write_identification(path: str | Path, found: Identification) -> None:
    """Write an identification to a TOML file.

    Raises:
        IdentificationError: If it cannot be written.
    """
    try:
        write_finding(path, found)
    except OSError as error:
        raise IdentificationError(f"{path} cannot be written: {error}.") from error


def read_identification(path: str | Path) -> Identification:
    """Return the identification in a TOML file.

    Raises:
        IdentificationError: If there is none, or it is damaged.
    """
    path = Path(path)
    if not path.is_file():
        raise IdentificationError(
            f"There is no identification {path}. Make one:  physx identify LOG ROBOT -o {path}"
        )
    try:
        return read_finding(Identification, path)
    except ValueError as error:
        raise IdentificationError(f"{path} is not an identification: {error}.") from error


def store_identification(session: str | Path, found: Identification, seconds: float = 0.0) -> None:
    """Keep an identification in a session's folder, which is made if it does not exist.

    Args:
        session: The folder.
        found: What to keep, in place of what was there.
        seconds: How long it took, in s.

    Raises:
        SessionError: If it cannot be written.
    """
    store_finding(session, FILE, found, seconds)
