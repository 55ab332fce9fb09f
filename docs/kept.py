"""Shared code of the pages of figures and examples: runs whose output is kept and shown."""

from __future__ import annotations

import argparse
import os
import platform
import subprocess
import sys
import textwrap
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path


def markdown(told: str, fence: str) -> str:
    """Return a docstring as Markdown, its indented parts as blocks that begin with `fence`."""
    parts = told.split("\n\n")
    for place, part in enumerate(parts):
        if part.startswith("    "):
            parts[place] = f"{fence}\n{textwrap.dedent(part)}\n```"
    return "\n\n".join(parts)


@dataclass(frozen=True)
class Page:
    """A page that ends with programs and the output of their last runs, or leads to them.

    Attributes:
        path: The page. Everything before its mark is written by hand.
        kept: Folder of the output, one text file per program.
        names: Returns the names of all programs.
        run: Runs a program and returns its exit status; its output goes through `keep`.
        section: Returns a program's section of the page.
        overview: Returns what comes before the sections.
        folder: Folder of the sections, if each is a page of its own.
    """

    path: Path
    kept: Path
    names: Callable[[], list[str]]
    run: Callable[[str], int]
    section: Callable[[str], str]
    overview: Callable[[], str] = str
    folder: Path | None = None

    @property
    def mark(self) -> str:
        """The line after which nothing is written by hand."""
        return f"<!-- What follows is written by {self.path.stem}.py. -->"

    def texts(self) -> dict[Path, str]:
        """Return the pages as they should be, by path, with the hand-written part unchanged."""
        written = self.path.read_text(encoding="utf-8").partition(self.mark)[0]
        begin = f"{written}{self.mark}\n{self.overview()}"
        sections = {name: self.section(name) for name in self.names()}
        if self.folder is None:
            return {self.path: "\n".join([begin, *sections.values()])}
        pages = {self.folder / f"{name}.md": text for name, text in sections.items()}
        return {self.path: begin, **pages}

    def write(self) -> None:
        """Write the pages."""
        for path, text in self.texts().items():
            path.parent.mkdir(exist_ok=True)
            path.write_text(text, encoding="utf-8")

    def keep(self, name: str, words: Sequence[str], folder: Path | None = None) -> int:
        """Run a command in a folder, keep what it prints, and return its exit status."""
        done = subprocess.run(words, cwd=folder, stdout=subprocess.PIPE, text=True, check=False)
        head = (
            f"{datetime.now(UTC):%Y-%m-%d}, {platform.system()} {platform.machine()}, "
            f"{os.cpu_count()} cores, Python {platform.python_version()}, "
            f"exit status {done.returncode}"
        )
        self.kept.mkdir(exist_ok=True)
        (self.kept / f"{name}.txt").write_text(
            f"{head}\n\n{done.stdout.lstrip()}", encoding="utf-8"
        )
        return done.returncode

    def printed(self, name: str) -> str:
        """Return a block with a program's kept output."""
        kept = self.kept / f"{name}.txt"
        told = kept.read_text(encoding="utf-8") if kept.is_file() else "No run is kept.\n"
        return f"```text\n{told}```\n"

    def main(self, doc: str) -> int:
        """Run the programs that the command line names, write the page, return the exit status."""
        parser = argparse.ArgumentParser(description=doc.partition("\n")[0])
        parser.add_argument("names", nargs="*", metavar="NAME")
        asked = parser.parse_args().names
        if unknown := set(asked) - set(self.names()):
            parser.error(f"no {', '.join(unknown)}; there are {', '.join(self.names())}")
        failed = [name for name in asked if self.run(name)]
        self.write()
        for name in failed:
            print(f"{name} misses a target", file=sys.stderr)
        return len(failed) > 0
