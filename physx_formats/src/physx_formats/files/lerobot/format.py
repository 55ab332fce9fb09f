"""The format ``lerobot``."""

from __future__ import annotations

from physx_formats.files.lerobot.reading import open_columns, recognizes
from physx_formats.files.lerobot.writing import write
from physx_formats.format import Format

FORMAT = Format(
    write=write,
    options=("observations", "actions", "rewards", "fps", "task", "features"),
    loses=("records", "colors"),
    recognizes=recognizes,
    open=open_columns,
)
