"""Blocks: what the sections of a page consist of; text in them is never read as HTML."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TypeAlias


@dataclass(frozen=True)
class Text:
    """Lines of text.

    Attributes:
        lines: The lines.
        kind: "plain", "verdict", the first thing to be read, or "code", as it is typed.
    """

    lines: Sequence[str]
    kind: str = "plain"


@dataclass(frozen=True)
class Table:
    """A table.

    Attributes:
        head: Titles of the columns.
        rows: Text of the cells, row by row.
        caption: What it shows.
        marks: Numbers of rows that are in bold.
    """

    head: Sequence[str]
    rows: Sequence[Sequence[str]]
    caption: str = ""
    marks: Sequence[int] = field(default=())


@dataclass(frozen=True)
class Figure:
    """A picture.

    Attributes:
        svg: The picture, as `physx_report.drawing.figure` returns it.
        caption: What it shows, for those who cannot see it as well.
    """

    svg: str
    caption: str


@dataclass(frozen=True)
class Picture:
    """A picture of pixels, or a film.

    Attributes:
        content: The file: WebP, GIF or PNG; animated ones are films.
        caption: What it shows.
    """

    content: bytes
    caption: str

    @property
    def mime(self) -> str:
        """The type of the file; empty if browsers do not show it as a picture."""
        known = {b"RIFF": "image/webp", b"GIF8": "image/gif", b"\x89PNG": "image/png"}
        return known.get(self.content[:4], "")


Block: TypeAlias = Text | Table | Figure | Picture
