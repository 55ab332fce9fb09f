"""Identifications in files: plain TOML, which training reads, and a session's, for its report."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from physx_core import Result, files
from physx_core.parsing import parse_toml
from physx_core.results import from_plain, store_result
from physx_identify.errors import IdentificationError
from physx_identify.result.identification import Identification

FILE = "identification.toml"
KIND = "identification"
"""What its result is called in a session."""
_LARGEST = 2**26


def write_identification(path: str | Path, found: Identification) -> None:
    """Write an identification to a TOML file.

    Raises:
        IdentificationError: If it cannot be written.
    """
    path = Path(path)
    try:
        files.replace(path, _content(found))
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
        found: Identification = from_plain(
            Identification, parse_toml(files.read_content(path, _LARGEST))
        )
    except (OSError, ValueError, TypeError, AttributeError, LookupError) as error:
        raise IdentificationError(f"{path} is not an identification: {error}.") from error
    return found


def store_identification(session: str | Path, found: Identification, seconds: float = 0.0) -> None:
    """Keep an identification in a session's folder, which is made if it does not exist.

    Args:
        session: The folder.
        found: What to keep, in place of what was there.
        seconds: How long it took, in s.

    Raises:
        SessionError: If it cannot be written.
    """
    result = Result(KIND, Path(session).name, seconds, str(found).splitlines())
    store_result(session, result, {FILE: _content(found)})


def _content(found: Identification) -> bytes:
    import tomli_w

    return tomli_w.dumps(_without_none(found.to_plain())).encode()


def _without_none(plain: Any) -> Any:
    """Return plain data without what TOML has no word for."""
    if isinstance(plain, Mapping):
        return {key: _without_none(each) for key, each in plain.items() if each is not None}
    if isinstance(plain, Sequence) and not isinstance(plain, str):
        return [_without_none(each) for each in plain]
    return plain
