"""Writes the table of docs/engines.md from what the engines say of themselves.

python docs/engines.py
"""

from __future__ import annotations

from pathlib import Path

from physx_core import plugins
from physx_sim import FEATURES, Box, World

PAGE = Path(__file__).resolve().parent / "engines.md"
ENGINES = ("dart", "pinocchio", "mujoco")
_BEGIN, _END = "<!-- table: written by docs/engines.py -->", "<!-- end of table -->"


def table() -> str:
    """Return the features of each engine as a Markdown table."""
    world = World(objects=[Box(name="box", size=(1.0, 1.0, 1.0))])
    rows = [[f"`{feature}`", meaning] for feature, meaning in FEATURES.items()]
    for engine in ENGINES:
        with plugins.resolve("backend", engine).build(world) as simulation:
            for row, feature in zip(rows, FEATURES, strict=True):
                has = feature in simulation.features
                row.append(simulation.caveats.get(feature, "yes") if has else "**no**")
    lines = [["feature", "", *ENGINES], ["---"] * (2 + len(ENGINES)), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def page() -> str:
    """Return the page with the table."""
    text = PAGE.read_text(encoding="utf-8")
    before, rest = text.partition(_BEGIN)[0], text.partition(_END)[2]
    return f"{before}{_BEGIN}\n\n{table()}\n\n{_END}{rest}"


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
