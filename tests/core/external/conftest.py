"""Programs for `external/program`, compiled from the sources beside the other tests' programs."""

from __future__ import annotations

import functools
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from physx_core.external import INCLUDE

SOURCES = Path(__file__).parents[1] / "programs" / "external"
WARNINGS = ("-Wall", "-Wextra", "-Werror", "-pedantic")
SANITIZERS = ("-fsanitize=address,undefined", "-fno-sanitize-recover=all", "-g")


@pytest.fixture(scope="session")
def compiler():
    """Return a function that skips the test where a compiler is missing, but not in CI."""
    return _compiler


def _compiler(name):
    """Return a compiler; the test is skipped where it is missing, but not in CI."""
    if shutil.which(name) is None and os.environ.get("CI") != "true":
        pytest.skip(f"the compiler {name} is not installed")
    return name


@pytest.fixture(scope="session")
def build(tmp_path_factory):
    """Return a function that compiles a source with ``physx.h``, once, and returns the program."""
    folder = tmp_path_factory.mktemp("built")

    @functools.cache
    def make(source, *flags, using="gcc"):
        program = folder / str(len(list(folder.iterdir())))
        inputs = [source] if isinstance(source, Path) else [SOURCES / source]
        if using == "gfortran":
            inputs = [INCLUDE / "physx.f90", INCLUDE / "physx_fortran.c", *inputs]
            flags = (*flags, "-J", str(folder))
        command = [_compiler(using), "-O2", *flags, f"-I{INCLUDE}", *map(str, inputs)]
        done = subprocess.run([*command, "-o", str(program)], capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        return str(program)

    return make


@pytest.fixture
def heat(build):
    """The heat equation in C, with sanitizers."""
    return build("heat.c", "-std=c99", *WARNINGS, *SANITIZERS)


@pytest.fixture
def heat_fortran(build):
    """The heat equation in Fortran, with sanitizers."""
    return build("heat.f90", *WARNINGS, *SANITIZERS, using="gfortran")


@pytest.fixture
def heat_python(tmp_path):
    """The heat equation in Python, without any package."""
    return _in_python(tmp_path, "-S", "")


@pytest.fixture
def heat_numpy(tmp_path):
    """The heat equation in Python, with NumPy's arrays."""
    return _in_python(tmp_path, "", "--numpy")


def _in_python(folder, option, word):
    script = folder / "heat"
    command = f'exec {sys.executable} {option} {SOURCES / "heat.py"} "$@" {word}'
    script.write_text(f"#!/bin/sh\n{command}\n")
    script.chmod(0o755)
    return str(script)


@pytest.fixture
def faulty(build):
    """A program that breaks in many ways."""
    return build("faulty.c", "-std=c99", "-D_POSIX_C_SOURCE=200809L", *WARNINGS, *SANITIZERS)
