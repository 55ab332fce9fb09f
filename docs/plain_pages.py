"""The site's pages as plain Markdown, and ``llms.txt``, which lists them: for language models.

``llms.txt`` follows https://llmstxt.org: a title, a summary, and links to the pages by topic.
"""

from __future__ import annotations

import importlib
import inspect
import re
from collections.abc import Iterator
from pathlib import Path

import public_names

ROOT = Path(__file__).parents[1]
INDEX = ROOT / "docs/index.md"
_TOCTREE = re.compile(r"```\{toctree\}\n(.*?)```\n*", re.DOTALL)
_FACE = re.compile(r"```\{eval-rst\}\n\.\. face:: ([\w.]+)\n```")
_SOURCE = re.compile(r"```\{literalinclude\} (\S+)\n:language: (\w+)\n```")
_COMMENT = re.compile(r"<!--.*?-->\n", re.DOTALL)


def topics() -> Iterator[tuple[str, list[Path]]]:
    """Yield the captions of the site's first page, each with its pages."""
    for body in _TOCTREE.findall(INDEX.read_text()):
        caption = re.findall(r"^:caption: (.*)$", body, re.MULTILINE)[0]
        yield caption, list(_pages(INDEX, body))


def _pages(page: Path, body: str) -> Iterator[Path]:
    """Yield the pages of a toctree, each followed by those of its own."""
    for line in body.splitlines():
        if line and not line.startswith(":"):
            place = re.sub(r".*<(.*)>", r"\1", line)
            for listed in sorted(page.parent.glob(f"{place}.md")):
                yield listed.resolve()
                for inner in _TOCTREE.findall(listed.read_text()):
                    yield from _pages(listed.resolve(), inner)


def plain(page: Path) -> str:
    """Return a page without the site's directives; the reference has the docstrings instead."""
    text = _COMMENT.sub("", _TOCTREE.sub("", page.read_text()))
    text = _SOURCE.sub(lambda it: f"```{it[2]}\n{(page.parent / it[1]).read_text()}```", text)
    return _FACE.sub(lambda match: _docstrings(match[1]), text)


def _docstrings(module: str) -> str:
    """Return the docstrings of the names that a module is the first to offer."""
    parts = [inspect.getdoc(importlib.import_module(module)) or ""]
    for each in public_names.described():
        if each.module != module:
            continue
        text = each.text if each.kind == "data" else inspect.getdoc(each.value) or ""
        parts.append(f"### {each.name}{_signature(each.value)}\n\n{text}")
        for name, member in vars(each.value).items() if inspect.isclass(each.value) else ():
            if not name.startswith("_") and (text := inspect.getdoc(member) or ""):
                parts.append(f"#### {each.name}.{name}{_signature(member)}\n\n{text}")
    return "\n\n".join(parts)


def _signature(value: object) -> str:
    if not callable(value):
        return ""
    try:
        return str(inspect.signature(value))
    except ValueError:
        return ""


def llms_txt() -> str:
    """Return the list of all pages, each with its first sentence."""
    summary = re.search(r"\*\*(.*?)\*\*", INDEX.read_text(), re.DOTALL)
    assert summary is not None
    lines = ["# physx", "", f"> {' '.join(summary[1].split())} It is not NVIDIA PhysX.", ""]
    for caption, pages in topics():
        lines += [f"## {caption}", ""]
        for page in pages:
            title, sentence = _beginning(page)
            lines.append(f"- [{title}]({page.relative_to(ROOT)}): {sentence}")
        lines.append("")
    return "\n".join(lines)


def write(folder: Path) -> None:
    """Write ``llms.txt`` and the pages into the folder of the site."""
    (folder / "llms.txt").write_text(llms_txt())
    for page in [INDEX, *(page for _, pages in topics() for page in pages)]:
        target = folder / page.relative_to(ROOT)
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_text(plain(page))


def _beginning(page: Path) -> tuple[str, str]:
    """Return the title of a page, and its first sentence without links."""
    title, _, text = plain(page).partition("\n")
    paragraphs = (" ".join(each.split()) for each in text.split("\n\n"))
    first = next((each for each in paragraphs if re.match(r"[\w`*\[]", each)), "")
    first = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", first)
    sentence = re.split(r"(?<=[.:]) ", first.replace("**", ""))[0]
    return title.lstrip("# "), sentence.rstrip(".:") + "."
