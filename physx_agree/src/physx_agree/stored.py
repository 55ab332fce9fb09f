"""Agreements as a session keeps them: a file of plain data beside the session's results."""

from __future__ import annotations

from pathlib import Path

from physx_agree.agreement import Agreement
from physx_core.errors import SessionError
from physx_core.results import read_finding, store_finding

FILE = "agreement.json"


def store_agreement(session: str | Path, agreement: Agreement, seconds: float = 0.0) -> None:
    """Keep an agreement in a session's folder, which is made if it does not exist.

    Args:
        session: The folder.
        agreement: What to keep, in place of what was there.
        seconds: How long it took, in s.

    Raises:
        SessionError: If it cannot be written.
    """
    store_finding(session, FILE, agreement, seconds)


def read_agreement(session: str | Path) -> Agreement | None:
    """Return a session's agreement; None if it has none.

    Raises:
        SessionError: If the file is damaged.
    """
    path = Path(session) / FILE
    if not path.is_file():
        return None
    try:
        return read_finding(Agreement, path)
    except ValueError as error:
        raise SessionError(f"{path} is damaged: {error}. Remove it.") from error
