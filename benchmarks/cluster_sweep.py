"""A sweep whose trials are killed: its result, and the cost of the kills.

    python benchmarks/cluster_sweep.py --check

Eight trials are each killed (SIGKILL) at three random moments. The table and all final parameters
are bit-identical to those of an undisturbed sweep. Only what no checkpoint held when a process was
killed is trained twice: less than an epoch per kill. Batches are counted, not seconds.
"""

from __future__ import annotations

import random
import sys
import tempfile
from pathlib import Path

import tomli_w
from measure import claim, finish

from physx_cluster.sweep import Definition, run_study
from physx_core import DataGeneration, EnvironmentConfig

PROGRAMS = Path(__file__).parents[1] / "tests" / "cluster" / "programs"
sys.path.insert(0, str(PROGRAMS))

from sweep_kills import sweep_with_kills  # noqa: E402

EPOCHS, BATCHES, KILLS, PARALLEL, SEED = 5, 8, 3, 2, 1
RATES, SEEDS = [0.05, 0.1, 0.2, 0.3], [0, 1]
TRIALS = len(RATES) * len(SEEDS)


def survives_kills() -> list[bool]:
    """Run the sweep with kills; print the claims and return whether they are met."""
    with tempfile.TemporaryDirectory(prefix="physx-sweep-") as name:
        folder = Path(name)
        file = write_study(folder)
        run_study(Definition.read(file), folder / "whole", lambda line: None)
        chance = random.Random(SEED)
        moments = {
            f"trial_{number:04}": sorted(chance.sample(range(1, EPOCHS * BATCHES), KILLS))
            for number in range(1, TRIALS + 1)
        }
        lost, kills = sweep_with_kills(file, folder / "killed", moments, BATCHES)
        spent = sum(place.stat().st_size for place in (folder / "killed").glob("*.batches"))
        extra = (spent - TRIALS * EPOCHS * BATCHES) / BATCHES
        same = table(folder / "whole") == table(folder / "killed")
        networks = parameters(folder / "whole") == parameters(folder / "killed")
    print(f"A sweep of {TRIALS} trials of {EPOCHS} epochs, {kills} kills")
    return [
        claim("kills", kills, at_least=TRIALS * KILLS),
        claim("tables are identical", same, at_least=1),
        claim("final parameters are identical", networks, at_least=1),
        claim("epochs trained twice, to those destroyed", extra, at_most=lost / BATCHES),
        claim("the same, to one epoch for each kill", extra, at_most=kills),
    ]


def write_study(folder: Path) -> Path:
    """Generate a dataset, and write the file of a study that uses it."""
    spring = EnvironmentConfig("toy/spring", as_tcp_ip_client=False, seed=1)
    options = {"session_dir": str(folder), "session_name": "data", "quiet": True}
    DataGeneration(spring, batch_nb=5, batch_size=20, **options).execute()
    training = {
        "epoch_nb": EPOCHS,
        "batch_size": 10,
        "dataset": {"existing_dir": str(folder / "data"), "view": {"fold": 0}},
        "network": {
            "network": "toy/linear",
            "network_kwargs": {"net_fields": ["state", "force"]},
            "optimization": f"{PROGRAMS / 'descent.py'}:Descent",
            "optimization_kwargs": {"pause": 0.02},
        },
    }
    plain = {
        "study": {"seeds": SEEDS},
        "run": {"parallel": PARALLEL},
        "parameters": {"training.network.lr": RATES},
        "pipelines": {"linear": {"training": training}},
    }
    file = folder / "sweep.toml"
    file.write_text(tomli_w.dumps(plain))
    return file


def table(study: Path) -> bytes:
    """Return the table of a study."""
    return (study / "trials.csv").read_bytes()


def parameters(study: Path) -> dict[str, bytes]:
    """Return the final parameters of each trial."""
    found = {}
    for folder in sorted(study.glob("trial_*/network")):
        last = max(folder.glob("network_[0-9]*"), key=lambda p: int(p.name.rpartition("_")[2]))
        found[folder.parent.name] = (last / "parameters.npz").read_bytes()
    return found


if __name__ == "__main__":
    finish(survives_kills())
