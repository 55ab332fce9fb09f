"""Suggests how to install a physx package: from where physx itself was installed.

The names of the physx packages are not reserved on any package index, so a hint that gives only a
name could lead to somebody else's package. PEP 610 records the origin of every package that did not
come from an index.
"""

from __future__ import annotations

import json
import re
from pathlib import Path, PurePosixPath
from typing import Any
from urllib.parse import urlsplit, urlunsplit

_CORE = "physx-core"


def install_hint(distribution: str, extra: str = "", *, update: bool = False) -> str:
    """Return a sentence on how to install a physx package.

    Args:
        distribution: Name of the package, for example ``physx-torch``.
        extra: Extra of the package to install with it.
        update: Whether it is already installed, but too old.
    """
    named = f"{distribution}[{extra}]" if extra else distribution
    try:
        where = _recorded()
        found = (_quoted(named) if where is None else _place(where, distribution, named)) or ""
    except Exception:  # the file was not written by pip, or damaged
        where, found = {}, ""
    if not found:
        place = _without_login(str((where or {}).get("url", ""))) or f"where {_CORE} came from"
        return f"{'Update' if update else 'Install'} {named} from {place}"
    command = f"pip install {'--upgrade ' if update else ''}{found}"
    return f"To {'update' if update else 'install'} it: {command}"


def _recorded() -> dict[str, Any] | None:
    """Return the PEP 610 record of the core; None: it came from an index."""
    from importlib.metadata import distribution

    text = distribution(_CORE).read_text("direct_url.json")
    if text is None:
        return None
    found = json.loads(text)
    if not isinstance(found, dict):
        raise ValueError("direct_url.json is not a table")
    return found


def _place(where: dict[str, Any], distribution: str, named: str) -> str | None:
    """Return pip's argument for a package next to the core; None: no package is known there."""
    url, folder = _without_login(where["url"]), distribution.replace("-", "_")
    extra = named.removeprefix(distribution)
    if "dir_info" in where:
        beside = _local(url).parent / folder
        editable = "-e " if where["dir_info"].get("editable") else ""
        exists = (beside / "pyproject.toml").is_file()
        return editable + _quoted(f"{beside}{extra}") if exists else None
    if "subdirectory" in where:
        beside_core = PurePosixPath(where["subdirectory"]).parent / folder
        if "vcs_info" in where:
            vcs = where["vcs_info"]
            revision = vcs.get("requested_revision") or vcs["commit_id"]
            url = f"{vcs['vcs']}+{url}@{revision}"
        return _quoted(f"{named} @ {url}#subdirectory={beside_core}")
    if url.startswith("file:"):
        files = sorted(_local(url).parent.glob(f"{folder}-*"), key=lambda f: f.suffix == ".whl")
        return _quoted(f"{files[-1]}{extra}") if files else None
    return None


def _local(url: str) -> Path:
    from urllib.request import url2pathname  # it imports all of http and ssl

    return Path(url2pathname(urlsplit(url).path))


def _without_login(url: str) -> str:
    parts = urlsplit(url)
    return urlunsplit(parts._replace(netloc=parts.netloc.rpartition("@")[2]))


def _quoted(text: str) -> str:
    return text if re.fullmatch(r"[\w./:+@=-]+", text) else f'"{text}"'
