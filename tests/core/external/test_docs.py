"""The page about programs in other languages: its programs are compiled, and its commands run."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from physx_core import Dataset

pytestmark = pytest.mark.processes

TEXT = (Path(__file__).parents[3] / "docs" / "external.md").read_text(encoding="utf-8")


def block(language, word):
    """Return the only block of a language with a word in it."""
    found = re.findall(r"^```(\w*)\n(.*?)^```$", TEXT, re.MULTILINE | re.DOTALL)
    (one,) = (text for name, text in found if name == language and word in text)
    return one


def run(commands):
    """Run the commands of a block in a shell."""
    Path("bin").mkdir(exist_ok=True)
    physx = Path("bin/physx")
    physx.write_text(f'#!/bin/sh\nexec "{sys.executable}" -m physx_core "$@"\n')
    physx.chmod(0o755)
    path = f"{Path('bin').absolute()}:{os.environ['PATH']}"
    done = subprocess.run(
        ["/bin/sh", "-e", "-c", commands],
        env={**os.environ, "PATH": path},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    return done.stderr


def rows_of(session, mode="training"):
    with Dataset.open(f"sessions/{session}/dataset") as dataset:
        return {name: dataset[mode][name][:] for name in dataset[mode]}


@pytest.mark.slow
def test_the_program_in_c(compiler):
    compiler("cc")
    Path("spring.c").write_text(block("c", "int main"))
    assert "training loss" in run(block("sh", "cc -O2"))
    rows = rows_of("data_generation")
    assert len(rows["state"]) == 1000
    goes_on = (rows["env_id"] == 1) & (rows["step"] % 100 > 0)
    before = (rows["env_id"] == 1) & (rows["step"] % 100 < 99)
    np.testing.assert_array_equal(rows["state"][goes_on], rows["next_state"][before])
    assert set(rows["episode"]) == set(range(5))
    run(block("sh", "physx/sobol \\\n"))
    assert len({*rows_of("data_generation_1", "parameters")["stiffness"]}) == 10


@pytest.mark.slow
def test_the_program_in_fortran(compiler):
    compiler("gfortran")
    Path("bar.f90").write_text(block("fortran", "program bar"))
    run(block("sh", "gfortran -O2"))
    rows = rows_of("data_generation")
    np.testing.assert_array_equal(rows["u"][1:100], rows["next_u"][:99])
    assert rows["u"].shape == (200, 20) and (rows["u"][0] != rows["u"][100]).any()


@pytest.mark.parametrize(("word", "source"), [("MPI_Bcast", "mean.c"), ("_open_part", "parts.c")])
def test_the_pieces_are_those_of_the_whole_programs(word, source):
    whole = (Path(__file__).parents[1] / "programs/external" / source).read_text()
    for line in block("c", word).splitlines():
        assert line.strip() in whole
