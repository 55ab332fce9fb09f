"""Runs the code in all README.md files and the pages in docs/, each in its own folder.

python docs/run_pages.py [PAGE ...]    # all pages, or some; reports which block failed, and how

The language of a block determines what happens to it:

=============  ====================================================================================
python         part of the page's program, which runs when commands follow or the page ends
sh             commands that must succeed
console        commands after ``$``, and their output: ``...`` matches anything
text, none     not code
=============  ====================================================================================

A comment on the line before the block changes that:

=================================  ================================================================
``<!-- file: NAME -->``            the block is written to that file, or appended if the page has
                                   written it before; a later command or program must name it, and
                                   so should the text, because readers do not see the comment
``<!-- fails -->``                 the last command must fail
``<!-- tested by PATH::TEST -->``  the block is only shown; that test or script runs it
``<!-- not run: REASON -->``       the block is only shown: it is another project's code
=================================  ================================================================

The pages in docs/learn build on each other, so they share a folder. ``examples`` is the
repository's folder. There is no display.
"""

from __future__ import annotations

import argparse
import doctest
import os
import re
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from markdown_it import MarkdownIt

ROOT = Path(__file__).resolve().parent.parent
LEARN = sorted((ROOT / "docs/learn").glob("*.md"))
PAGES = [
    ROOT / "README.md",
    *sorted(ROOT.glob("physx*/README.md")),
    *sorted(page for page in (ROOT / "docs").rglob("*.md") if "_build" not in page.parts),
]
BOOKS = [LEARN, *([page] for page in PAGES if page not in LEARN)]
COMMENT = re.compile(r"<!-- (file|tested by|not run|fails):? ?(.*?) ?-->\n?")
COMMAND = re.compile(r"\$? ?(physx|python|pip|make|torchrun|apt|rerun)[ -]")
SAME = doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE
TIMEOUT = 300  # seconds per command


class PageError(Exception):
    """A block of a page does not do what the page says."""


@dataclass(frozen=True)
class Block:
    """A block of code.

    Attributes:
        page: Path of the page.
        line: Line of the page, counted from 1.
        language: The text after the three backticks.
        text: The code.
        file: Name of the file that it is written to, or an empty string.
        tested_by: What runs it instead, or an empty string.
        not_run: Why it is not run, or an empty string.
        fails: Whether the last command must fail.
    """

    page: Path
    line: int
    language: str
    text: str
    file: str = ""
    tested_by: str = ""
    not_run: str = ""
    fails: bool = False

    @property
    def is_shown_only(self) -> bool:
        """Whether it is not run here."""
        return bool(self.tested_by or self.not_run) or self.language in ("", "text")

    def error(self, message: str) -> PageError:
        """Return an error that names the block."""
        return PageError(f"{self.page.relative_to(ROOT)}, line {self.line}: {message}")


def read(page: Path) -> list[Block]:
    """Return the blocks of a page, without the site's directives."""
    found, told = [], {}
    for token in MarkdownIt("commonmark").parse(page.read_text(encoding="utf-8")):
        if token.type == "html_block" and (match := COMMENT.fullmatch(token.content)):
            told = {match[1].replace(" ", "_"): match[2]}
        elif token.type == "fence":
            options = {**told, "fails": True} if "fails" in told else told
            if not token.info.startswith("{"):
                line = (token.map or [0])[0] + 1
                found.append(Block(page, line, token.info.strip(), token.content, **options))
            told = {}
    return found


def check(blocks: list[Block]) -> None:
    """Check that each block of a page runs, or names what runs it.

    Raises:
        PageError: If a block does neither.
    """
    for number, block in enumerate(blocks):
        if block.tested_by:
            _check_test(block)
        elif block.not_run:
            continue
        elif block.file:
            after = blocks[number + 1 :]
            if not any(block.file.removesuffix(".py") in each.text for each in after):
                raise block.error(f"no command or program after it names {block.file}")
        elif block.language in ("", "text"):
            if COMMAND.match(block.text):
                raise block.error("commands are sh or console, and what is not run says so")
        elif block.language not in ("python", "sh", "console"):
            raise block.error(f"{block.language} is not run: name a file, or what tests it")


def _check_test(block: Block) -> None:
    path, _, test = block.tested_by.partition("::")
    if not (ROOT / path).is_file():
        raise block.error(f"{path} does not exist")
    if test and f"def {test}(" not in (ROOT / path).read_text(encoding="utf-8"):
        raise block.error(f"{path} has no {test}")


def commands(block: Block) -> Iterator[tuple[str, str]]:
    """Return the commands of a block, each with its output; an empty text matches anything."""
    if block.language == "sh":
        yield block.text, ""
        return
    beginning, *parts = re.split(r"^\$ ", block.text, flags=re.MULTILINE)
    if beginning.strip() or not parts:
        raise block.error("a console block begins with $ and a command")
    for part in parts:
        end = re.search(r"(?<!\\)\n", part)
        place = end.start() if end else len(part)
        yield part[:place], part[place + 1 :]


class Runner:
    """Runs the blocks of a page in a folder."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._program: list[Block] = []
        (folder / "examples").symlink_to(ROOT / "examples")
        path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ.get('PATH', '')}"
        self._environment = {
            **{name: text for name, text in os.environ.items() if "DISPLAY" not in name},
            "PATH": path,
            "MPLBACKEND": "agg",
            "OMP_NUM_THREADS": "1",
            "PYTHONUNBUFFERED": "1",
            "COLUMNS": "100",
        }

    def run(self, block: Block) -> None:
        """Run a block, or keep it for the program that it belongs to."""
        if block.is_shown_only:
            return
        if block.file:
            with (self._folder / block.file).open("a", encoding="utf-8") as file:
                file.write(block.text)
        elif block.language == "python":
            self._program.append(block)
        elif block.language in ("sh", "console"):
            self.finish()
            for command, printed in commands(block):
                self._execute(block, ["/bin/sh", "-e", "-c", command], printed)

    def finish(self) -> None:
        """Run the pending program."""
        if not self._program:
            return
        first, text = self._program[0], "\n".join(block.text for block in self._program)
        self._program = []
        name = f"page_{first.line}.py"
        (self._folder / name).write_text(text, encoding="utf-8")
        self._execute(first, [sys.executable, name], "")

    def _execute(self, block: Block, words: list[str], printed: str) -> None:
        done = subprocess.run(
            words,
            cwd=self._folder,
            env=self._environment,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            timeout=TIMEOUT,
            check=False,
        )
        if bool(done.returncode) != block.fails:
            raise block.error(f"{words[-1]}\nexit status {done.returncode}\n{done.stdout}")
        if printed and not doctest.OutputChecker().check_output(printed, done.stdout, SAME):
            raise block.error(f"{words[-1]}\nprints\n{done.stdout}\nand not\n{printed}")


def run(pages: list[Path], folder: Path) -> int:
    """Run the blocks of pages that build on each other, in an empty folder.

    Returns:
        Number of blocks that ran.

    Raises:
        PageError: If a block failed, printed something else, or does not name what runs it.
    """
    runner, ran = Runner(folder), 0
    blocks = [block for page in pages for block in read(page)]
    check(blocks)
    for block in blocks:
        runner.run(block)
        ran += not block.is_shown_only
    runner.finish()
    return ran


def main() -> int:
    """Run the pages that the command line names, and return the exit status."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("pages", nargs="*", type=Path, help="README.md, docs/online.md, ...")
    asked = {page.resolve() for page in parser.parse_args().pages}
    failed = 0
    for pages in BOOKS:
        if asked and not asked.intersection(pages):
            continue
        with tempfile.TemporaryDirectory() as folder:
            try:
                print(f"{pages[-1].relative_to(ROOT)}: {run(pages, Path(folder))} blocks")
            except PageError as error:
                failed += 1
                print(error, file=sys.stderr)
    return int(failed > 0)


if __name__ == "__main__":
    sys.exit(main())
