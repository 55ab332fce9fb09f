"""Draws the picture of docs/views.md: which rows nine small views learn from.

python docs/nine_views.py    # writes views.png
"""

from __future__ import annotations

import contextlib
import tempfile
from pathlib import Path
from typing import TypeAlias

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from physx_core import Dataset, View
from physx_core.dataset import EpisodeRecord

VIEWS = {
    "A fifth is held back": View(),
    "And another for a test": View(fold=0, test_fold=1),
    "Windows": View(window={"past": ("x", [-2, -1, 0]), "next": ("x", 1)}),
    "One in four": View(window={"past": ("x", [-2, -1, 0]), "next": ("x", 1)}, stride=4),
    "Beyond the ends": View(window={"past": ("x", [-2, -1, 0]), "next": ("x", 1)}, edges="pad"),
    "Chosen episodes": View(episodes={"p": [0.3, 0.7]}, hold_back=False),
    "Equal weights": View(weights="episode", hold_back=False),
    "Two datasets": View(sources={"a": 0.7, "b": 0.3}, hold_back=False),
    "In their order": View(order="stored", hold_back=False),
}
LENGTHS = {"a": [12, 12, 5, 12, 9, 12, 12, 3, 12, 12], "b": [12, 6, 12, 12, 8]}
CELL, GAP, TITLE, MARGIN = 16, 2, 34, 18
NOTHING, TRAINING, HELD, TEST = (229, 231, 235), (47, 111, 178), (232, 137, 42), (86, 160, 90)
OFTEN, PAST, NEXT = (20, 47, 86), (120, 94, 180), (200, 55, 90)
WIDTH = 12 * (CELL + GAP)
Color: TypeAlias = tuple[int, int, int]


def store(folder: Path, lengths: list[int]) -> None:
    """Store episodes of some lengths, each with a parameter p, a tenth of its number."""
    with Dataset.create(folder) as dataset:
        for number, length in enumerate(lengths):
            rows = {
                "x": np.arange(length, dtype=float), "step": np.arange(length),
                "episode": np.full(length, number), "env_id": np.zeros(length, int),
            }  # fmt: skip
            record = EpisodeRecord(episode=number, rows=length, parameters={"p": number / 10})
            dataset.append_episodes("training", rows, [record])


def visited(view: View, folder: str, part: str = "training", first: bool = False) -> np.ndarray:
    """Return the rows of a dataset that an epoch visits, or only its first batch of ten."""
    place = list(view.sources or [folder]).index(folder)
    with view.open(10, seed=1, data=None if view.sources else folder, part=part) as batches:
        numbers = range(1 if first else len(batches))
        return np.concatenate([batches.rows(number)[place] for number in numbers])


def colors(view: View, folder: str) -> list[Color]:
    """Return the color of each row of a dataset."""
    rows = visited(view, folder, first=bool(view.sources) or view.order == "stored")
    counts = np.bincount(rows, minlength=sum(LENGTHS[folder]))
    found = [(NOTHING, TRAINING, OFTEN)[min(int(count), 2)] for count in counts]
    for part, color in (("validation", HELD), ("test", TEST)):
        for row in visited(view, folder, part) if view.held[part] is not None else ():
            found[row] = color
    for name, window in view.windows.items():  # of the first item
        for offset in window.at:
            found[max(int(rows.min()) + offset, 0)] = NEXT if name == "next" else PAST
    return found


def draw(canvas: ImageDraw.ImageDraw, left: int, top: int, title: str, view: View) -> None:
    """Draw one view: an episode in each line, a row in each cell."""
    canvas.text((left, top), title, (31, 41, 55), ImageFont.load_default(19))
    y = top + TITLE
    for folder in view.sources or ["a"]:
        found = iter(colors(view, folder))
        for length in LENGTHS[folder]:
            for step in range(length):
                x = left + step * (CELL + GAP)
                canvas.rectangle((x, y, x + CELL - 1, y + CELL - 1), next(found))
            y += CELL + GAP
        y += CELL


def picture() -> Image.Image:
    """Draw the views, three in each line."""
    heights = [TITLE + 10 * (CELL + GAP) + MARGIN] * 2 + [TITLE + 16 * (CELL + GAP) + MARGIN]
    image = Image.new("RGB", (3 * (WIDTH + 2 * MARGIN), sum(heights) + MARGIN), "white")
    canvas = ImageDraw.Draw(image)
    for number, (title, view) in enumerate(VIEWS.items()):
        row, column = divmod(number, 3)
        left, top = MARGIN + column * (WIDTH + 2 * MARGIN), MARGIN + sum(heights[:row])
        draw(canvas, left, top, title, view)
    return image


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as name, contextlib.chdir(name):
        for folder, lengths in LENGTHS.items():
            store(Path(folder), lengths)
        drawn = picture()
    drawn.quantize(64).save(Path(__file__).with_name("views.png"), optimize=True)
