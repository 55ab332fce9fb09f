"""Runs a benchmark with a single round: ``one_round.py NAME``."""

import importlib
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[3] / "benchmarks"))

if __name__ == "__main__":
    module = importlib.import_module(sys.argv.pop())
    module.ROUNDS = 1
    module.main()
