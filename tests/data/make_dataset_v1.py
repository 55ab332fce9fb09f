"""Makes dataset_v1, a dataset in version 1 of the format, which every later physx has to read.

It was run once, by the first physx; its result is kept. Usage: python make_dataset_v1.py FOLDER
"""

import sys
from pathlib import Path

import numpy as np

from physx_core import Dataset, Field


def main(folder: Path) -> None:
    x = np.arange(30.0).reshape(10, 3) / 7
    with Dataset.create(folder, "first", max_file_size=1.655e-5, info={"seed": 1}) as dataset:
        dataset.define_fields(
            "training",
            [
                Field("x", (3,), unit="m"),
                Field("flag", (), "bool"),
                Field("wave", (2,), "complex64"),
                Field("step", (), "int64", role="additional"),
            ],
        )
        for part in (slice(0, 6), slice(6, 10)):
            dataset.append(
                "training",
                {
                    "x": x[part],
                    "flag": x[part, 0] > 2,
                    "wave": (x[part, :2] * (1 + 2j)).astype("complex64"),
                    "step": np.arange(10)[part],
                },
            )
    with Dataset.open(folder, writable=True, session="second") as dataset:
        dataset.append("validation", {"x": x[:2].astype("float32")})
        dataset.append(
            "training",
            {"x": -x[:1], "flag": [True], "wave": np.ones((1, 2), "complex64"), "step": [99]},
        )
    (folder / "dataset.lock").unlink()


if __name__ == "__main__":
    main(Path(sys.argv[1]))
