"""How much of physx is on the way: calls of its functions on the main roads, modules, and lines.

Nothing is timed, so every machine gives the same figures. A call is one of a Python function inside
physx's packages; those of the environment count, those of libraries do not. Printed are the fewest
of several batches or steps: some of them also finish a block of rows, or write numbers to a file. A
life is generation over TCP, training and prediction of the toy environment: what the run and its
client load.
"""

from __future__ import annotations

import re
import subprocess
import sys
import tempfile
from pathlib import Path
from types import FrameType
from typing import Any

import torch
from measure import claim, finish

import physx_core
from physx_core import (
    DataGeneration,
    DatasetConfig,
    EnvironmentConfig,
    NetworkConfig,
    Prediction,
    Training,
)

ROOT = Path(__file__).resolve().parents[1]
OURS = re.compile(r"[/\\]physx_[a-z]+[/\\]")
ROWS, BATCHES = 5, 29
HERE = EnvironmentConfig("toy/spring", as_tcp_ip_client=False, seed=0)
LIFE = """
import sys
from pathlib import Path
from physx_core import (
    DataGeneration, DatasetConfig, EnvironmentConfig, NetworkConfig, Prediction, Training
)
from physx_core.toy import Spring

def loaded():
    return {m.__file__ for n, m in sys.modules.items() if n.split(".")[0] == "physx_core"}

class Told(Spring):
    def close(self):
        super().close()
        Path(__file__).with_suffix(".client").write_text("\\n".join(loaded()))

if __name__ == "__main__":
    common = {"session_dir": sys.argv[1], "quiet": True}
    spring = EnvironmentConfig(f"{__file__}:Told", seed=0)
    made = DataGeneration(spring, session_name="made", batch_nb=2, batch_size=50, **common)
    made.execute()
    network = NetworkConfig("toy/linear", network_kwargs={"net_fields": ["state", "force"]})
    data = DatasetConfig(existing_dir=made.session.path)
    Training(network, data, session_name="t", epoch_nb=1, batch_size=10, **common).execute()
    here = EnvironmentConfig("toy/spring", as_tcp_ip_client=False, seed=0)
    Prediction(network, here, session_name="t", step_nb=3, **common).execute()
    print(*loaded(), sep="\\n")
"""


class Counter:
    """Counts the calls of each part of a run between `begin` and `end`."""

    def __init__(self) -> None:
        self._calls: list[int] = []

    def _count(self, frame: FrameType, event: str, _: Any) -> None:
        if event == "call" and OURS.search(frame.f_code.co_filename):
            self._calls[-1] += 1

    def begin(self) -> None:
        """Start counting."""
        self._calls.append(0)
        sys.setprofile(self._count)

    def end(self) -> None:
        """Stop counting."""
        sys.setprofile(None)

    @property
    def fewest(self) -> int:
        """Calls of the part with the fewest."""
        return min(self._calls)


def calls_of_a_batch(folder: str, rows: int) -> int:
    """Return the calls of a batch generated in this process and stored."""
    counter = Counter()

    class Counted(DataGeneration):
        def batch_produce(self) -> None:
            counter.begin()
            super().batch_produce()
            counter.end()

    Counted(
        HERE,
        session_dir=folder,
        session_name=f"generation_{rows}",
        batch_nb=BATCHES,
        batch_size=rows,
        quiet=True,
    ).execute()
    return counter.fewest


def calls_of_learning(folder: str) -> tuple[int, int]:
    """Return the calls of a batch of training, and of a step of prediction, with PyTorch."""
    trained, predicted = Counter(), Counter()
    generation = DataGeneration(
        HERE, session_dir=folder, session_name="data", batch_nb=4, batch_size=50, quiet=True
    )
    generation.execute()
    layers = {"layers": [2, 8, 2], "net_fields": "state", "opt_fields": "next_state"}
    network = NetworkConfig(
        "torch/fc", loss="MSELoss", optimizer="Adam", lr=1e-3, network_kwargs=layers
    )

    class CountedTraining(Training):
        def batch_begin(self) -> None:
            trained.begin()

        def batch_end(self) -> None:
            trained.end()

    class CountedPrediction(Prediction):
        def sample_begin(self) -> None:
            predicted.begin()

        def sample_end(self) -> None:
            predicted.end()

    common: dict[str, Any] = {"session_dir": folder, "session_name": "learning", "quiet": True}
    stored = DatasetConfig(existing_dir=str(generation.session.path))
    CountedTraining(network, stored, epoch_nb=1, batch_size=10, **common).execute()
    CountedPrediction(network, HERE, step_nb=BATCHES, **common).execute()
    return trained.fewest, predicted.fewest


def lines_of(folder: Path) -> int:
    """Return the lines of a folder's Python files."""
    return sum(path.read_bytes().count(b"\n") for path in folder.rglob("*.py"))


def main() -> None:
    """Count and print."""
    torch.set_num_threads(1)
    met = []
    with tempfile.TemporaryDirectory() as folder:
        few, many = calls_of_a_batch(folder, ROWS), calls_of_a_batch(folder, 2 * ROWS)
        batch, step = calls_of_learning(folder)
        program = Path(folder) / "life.py"
        program.write_text(LIFE)
        command = [sys.executable, str(program), folder]
        done = subprocess.run(command, capture_output=True, text=True, check=True)
        alone = set(done.stdout.split())
        loaded = alone | set(program.with_suffix(".client").read_text().split())
    row = (many - few) / ROWS
    print("Calls inside physx")
    met.append(claim("a row generated in this process", row, at_most=8))
    met.append(claim("a batch of rows, besides", few - row * ROWS, at_most=25))
    met.append(claim("a batch of training", batch, at_most=45))
    met.append(claim("a step of prediction", step, at_most=50))
    core = Path(physx_core.__file__).parent
    modules = len(list(core.rglob("*.py")))
    print(f"A life loads {len(loaded)} of {modules} modules of the core, {len(alone)} in the run")
    met.append(claim("share of the modules", len(loaded) / modules, at_least=0.8))
    print("Lines of Python")
    met.append(claim("physx_core", lines_of(core), at_most=31_000))
    packages = [path for path in ROOT.glob("physx_*/src") if path.is_dir()]
    met.append(claim("all packages", sum(map(lines_of, packages)), at_most=79_000))
    finish(met)


if __name__ == "__main__":
    main()
