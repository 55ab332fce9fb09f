"""Page: one HTML file that opens from a disk and prints; it has no script."""

from __future__ import annotations

import base64
from collections.abc import Iterable
from functools import cache
from html import escape
from pathlib import Path
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined

from physx_core import cli, files
from physx_core.cli import in_notebook
from physx_core.errors import PhysxError, SessionError
from physx_report.blocks import Block, Figure, Picture, Table, Text
from physx_report.errors import ReportError
from physx_report.run import Run
from physx_report.section import Section, all_sections

NAME = "report.html"
"""Name of the page in the session's folder."""
_FRAME = "width: 100%; height: 40em; border: 0"


def write_report(
    session: str | Path, path: str | Path | None = None, *, trust: bool = False
) -> Path:
    """Write what a session has found to an HTML page; equal sessions give equal bytes.

    Args:
        session: The session's folder.
        path: The page, which is replaced; None: ``report.html`` in the session's folder.
        trust: Whether to import whatever code the session's files name.

    Returns:
        The page.

    Raises:
        SessionError: If the session has no result, or the page cannot be written.
        ReportError: If a section fails.
        PluginError: If a plugin is broken.
    """
    with Run(session, trust=trust) as run:
        place = run.path / NAME if path is None else Path(path)
        text = page_of(run, all_sections())
    try:
        files.replace(place, text.encode())
    except OSError as error:
        raise SessionError(f"{place} cannot be written: {error}.") from error
    return place


def show(session: str | Path, path: str | Path | None = None, *, trust: bool = False) -> None:
    """Write a session's page: see `write_report`. Show it below the notebook's cell.

    Elsewhere, print its path. The notebook keeps the page, also if its file is removed.

    Args:
        session: The session's folder.
        path: The page, which is replaced; None: ``report.html`` in the session's folder.
        trust: Whether to import whatever code the session's files name.

    Raises:
        PhysxError: If the page cannot be written.
    """
    place = write_report(session, path, trust=trust)
    if not in_notebook():
        cli.show(f"report: {place}")
        return
    from IPython.display import HTML, display

    text = escape(place.read_text(encoding="utf-8"))
    display(HTML(f'<div><iframe sandbox srcdoc="{text}" style="{_FRAME}"></iframe></div>'))


def page_of(run: Run, sections: Iterable[Section]) -> str:
    """Return a session's page with some sections.

    Raises:
        ReportError: If a section fails.
    """
    found = [(each.title, _blocks(each, run)) for each in sections]
    kinds = ", ".join(kind.replace("_", " ") for kind in run.results)
    text: str = _template().render(
        title=f"{run.path.name}: {kinds}",
        sections=[(title, _plain(blocks)) for title, blocks in found if blocks],
    )
    return text


def _blocks(section: Section, run: Run) -> list[Block]:
    try:
        return list(section.blocks(run))
    except PhysxError:
        raise
    except Exception as error:  # a plugin may raise anything
        what = f"{type(error).__name__}: {error}"
        raise ReportError(f'The section "{section.title}" of the report failed: {what}') from error


def _plain(blocks: Iterable[Block]) -> list[tuple[str, Any]]:
    """Return blocks as the template takes them, with the name of each kind."""
    found: list[tuple[str, Any]] = []
    for block in blocks:
        match block:
            case Text():
                found.append(("text", block))
            case Table():
                found.append(("table", block))
            case Figure():
                found.append(_image("image/svg+xml", block.svg.encode(), block.caption))
            case Picture(mime=mime) if mime:
                found.append(_image(mime, block.content, block.caption))
            case _:
                raise ReportError(f"A section of a report has {block!r}, which is no block.")
    return found


def _image(mime: str, content: bytes, caption: str) -> tuple[str, Any]:
    return "image", (f"data:{mime};base64,{base64.b64encode(content).decode()}", caption)


@cache
def _template() -> Any:
    loader = PackageLoader("physx_report", "templates")
    made = Environment(
        loader=loader, autoescape=True, undefined=StrictUndefined, trim_blocks=True,
        lstrip_blocks=True,
    )  # fmt: skip
    return made.get_template("page.html")
