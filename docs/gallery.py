"""Runs examples in full, keeps their output and pictures, and shows each on a page of its own.

python docs/gallery.py NAME ...    # runs examples/NAME, such as 02_train: minutes
python docs/gallery.py             # writes docs/gallery.md and docs/gallery/ from what is kept

What is kept is in docs/examples/. An example's page is built from its beginning: the docstring of a
script, the comment of a TOML file, or the README of a folder up to its first table. A script draws
the picture (``--picture``), as a film if its docstring says ``--picture NAME.webp``; other examples
leave it where their commands are run. A script is a notebook as well.
"""

from __future__ import annotations

import ast
import json
import re
import shutil
import sys
import tempfile
from pathlib import Path

import kept
from PIL import Image

HERE = Path(__file__).resolve().parent
EXAMPLES = HERE.parent / "examples"
GREATEST = 150_000  # bytes; larger pictures are reduced to 256 colors
TEST = "<!-- tested by tests/examples/test_all.py -->"


def path_of(name: str) -> Path:
    """Return the file or folder of an example."""
    [found] = [path for path in EXAMPLES.iterdir() if name in (path.name, path.stem)]
    return found


def names() -> list[str]:
    """Return the names of all examples: the numbered ones in order, then the others."""
    numbered = {path.stem for path in EXAMPLES.glob("[0-9][0-9]_*")}
    others = {path.parent.name for path in EXAMPLES.glob("*/README.md")}
    return sorted(numbered) + sorted(others - numbered)


def beginning(name: str) -> str:
    """Return an example's introduction: its title, text and commands, as in a docstring."""
    path = path_of(name)
    if path.is_dir():
        told = (path / "README.md").read_text(encoding="utf-8").partition("\n|")[0]
        return told.removeprefix("# ").strip()
    text = path.read_text(encoding="utf-8")
    if path.suffix == ".py":
        return ast.get_docstring(ast.parse(text)) or ""
    lines = text.partition("\n\n")[0].splitlines()
    return "\n".join(line.removeprefix("#").removeprefix(" ") for line in lines)


def commands(name: str) -> str:
    """Return the shell commands in an example's introduction."""
    told = beginning(name)
    if path_of(name).is_dir():
        return "\n".join(re.findall(r"^```sh\n(.*?)^```", told, re.MULTILINE | re.DOTALL))
    return "\n".join(line.strip() for line in told.splitlines() if line.startswith("    "))


def picture(name: str) -> Path:
    """Return the path of an example's picture, or of its film."""
    film = re.search(r"--picture \S+\.webp", beginning(name))
    return HERE / "examples" / f"{name}{'.webp' if film else '.png'}"


def run(name: str) -> int:
    """Run an example in full in an empty folder, keep its picture, and return its exit status."""
    drawn = picture(name)
    drawn.parent.mkdir(exist_ok=True)
    status = draw(name, drawn)
    if drawn.suffix == ".png" and drawn.is_file() and drawn.stat().st_size > GREATEST:
        with Image.open(drawn) as image:
            few = image.convert("RGB").quantize(256)
        few.save(drawn, optimize=True)
    return status


def draw(name: str, drawn: Path) -> int:
    """Run an example in full in an empty folder, and keep what it prints and draws."""
    path = path_of(name)
    with tempfile.TemporaryDirectory() as folder:
        if path.suffix == ".py":
            words = [sys.executable, str(path), "--picture", str(drawn)]
            return PAGE.keep(name, words, Path(folder))
        Path(folder, "examples").symlink_to(EXAMPLES)
        script = f'PATH="{Path(sys.executable).parent}:$PATH"\nexec 2>&1\n{commands(name)}'
        status = PAGE.keep(name, ["/bin/sh", "-e", "-c", script], Path(folder))
        found = [each for each in Path(folder).rglob(f"*{drawn.suffix}") if each.is_file()]
        if found:
            shutil.copyfile(max(found, key=lambda each: each.stat().st_mtime), drawn)
    return status


def head(name: str, fence: str) -> str:
    """Return an example's introduction as Markdown, its commands as blocks after `fence`."""
    told = beginning(name).partition("\n")[2]
    return f"# {title_of(name)}\n\n{kept.markdown(told.strip(), fence)}"


def page(name: str) -> str:
    """Return an example's page: what it shows, its picture, its output and its source."""
    path, drawn = path_of(name), picture(name)
    parts = [head(name, f"{TEST}\n```sh")]
    if drawn.is_file():
        parts.append(f"![{title_of(name)}](../examples/{drawn.name})")
    if (PAGE.kept / f"{name}.txt").is_file():
        parts.append(PAGE.printed(name).rstrip("\n"))
    place = f"../../examples/{path.name}"
    if path.is_dir():
        parts.append(f"Files: [examples/{path.name}]({place}/README.md)")
    else:
        links = f"Source: [{path.name}]({place})"
        if path.suffix == ".py":
            links += f", or as a notebook, [{name}.ipynb]({name}.ipynb)"
            links += "; both import modules of the folder `examples`: put them there"
        language = {".py": "python"}.get(path.suffix, path.suffix[1:])
        source = f"```{{literalinclude}} {place}\n:language: {language}\n```"
        parts += [f"{links}.", source]
    return "\n\n".join(parts) + "\n"


def notebook(name: str) -> str:
    """Return a script as a notebook in JSON: its docstring as text, its parts as cells."""
    source = path_of(name).read_text(encoding="utf-8")
    code = source.split('"""', 2)[2].strip()
    code = re.sub(r"(?:sys\.exit|raise SystemExit)\((.*)\)$", r"\1", code)  # a kernel goes on
    begin = (
        f'import sys\n\n__file__, __doc__ = "{name}.py", {title_of(name)!r}\n'
        'sys.argv = [__file__, "--small"]  # without it in full'
    )
    cells = [("markdown", head(name, "```sh")), ("code", begin)]
    cells += [("code", part) for part in re.split(r"\n{3,}", code)]
    only = {"markdown": {}, "code": {"execution_count": None, "outputs": []}}
    made = [
        {"cell_type": kind, "id": f"{number}", "metadata": {}, "source": text, **only[kind]}
        for number, (kind, text) in enumerate(cells)
    ]
    kernel = {"name": "python3", "display_name": "Python 3", "language": "python"}
    whole = {"nbformat": 4, "nbformat_minor": 5, "metadata": {"kernelspec": kernel}, "cells": made}
    return json.dumps(whole, indent=1, ensure_ascii=False) + "\n"


def write_notebooks() -> None:
    """Write the scripts as notebooks beside their pages."""
    for name in names():
        if path_of(name).suffix == ".py":
            PAGES.joinpath(f"{name}.ipynb").write_text(notebook(name), encoding="utf-8")


def title_of(name: str) -> str:
    """Return the title of an example's page."""
    return beginning(name).partition("\n")[0].rstrip(".")


def overview() -> str:
    """Return a grid of pictures with titles, each of which leads to its example."""
    cells = []
    for name in filter(lambda each: picture(each).is_file(), names()):
        title = title_of(name)
        cells.append(f"[![{title}](examples/{picture(name).name}) {title}](gallery/{name}.md)")
    return "\n" + "\n".join(cells) + "\n"


PAGES = HERE / "gallery"
PAGE = kept.Page(HERE / "gallery.md", HERE / "examples", names, run, page, overview, PAGES)

if __name__ == "__main__":
    sys.exit(PAGE.main(__doc__ or ""))
