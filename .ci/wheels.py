"""Builds all packages into a folder, with an index of them (PEP 503): python .ci/wheels.py dist."""

from __future__ import annotations

import argparse
import hashlib
import html
import re
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent


def build(folder: Path) -> list[Path]:
    """Build wheels and source distributions, and return their files."""
    for project in sorted(ROOT.glob("physx*/pyproject.toml")):
        command = [sys.executable, "-m", "hatchling", "build", "-d", str(folder.resolve())]
        done = subprocess.run(
            command, cwd=project.parent, capture_output=True, text=True, check=False
        )
        if done.returncode:
            raise SystemExit(f"{project.parent.name} cannot be built:\n{done.stderr}")
    return sorted([*folder.glob("*.whl"), *folder.glob("*.tar.gz")])


def index(files: list[Path], folder: Path) -> None:
    """Write the pages of a package index that links to the files, which lie above it."""
    packages: dict[str, list[str]] = {}
    for file in files:
        name = re.sub(r"[-_.]+", "-", file.name.partition("-")[0]).lower()
        digest = hashlib.sha256(file.read_bytes()).hexdigest()
        link = f'<a href="../../{html.escape(file.name)}#sha256={digest}">{file.name}</a>'
        packages.setdefault(name, []).append(link)
    root = [f'<a href="{name}/">{name}</a>' for name in packages]
    for name, links in {".": root, **packages}.items():
        page = folder / name / "index.html"
        page.parent.mkdir(parents=True, exist_ok=True)
        lines = "<br>\n".join(links)
        page.write_text(f"<!DOCTYPE html>\n<title>{name}</title>\n{lines}\n", encoding="utf-8")


def main() -> None:
    """Build into the folder that the command line names."""
    parser = argparse.ArgumentParser(description="Build all packages, and an index of them.")
    parser.add_argument("folder", type=Path)
    folder = parser.parse_args().folder
    for old in [*folder.glob("*.whl"), *folder.glob("*.tar.gz")]:
        old.unlink()  # an index of two versions would offer both
    files = build(folder)
    index(files, folder / "simple")
    print(f"{len(files)} files: uvx --index {folder / 'simple'} physx demo")


if __name__ == "__main__":
    main()
