"""Every example runs, and says what it is to show."""

import importlib.util
import re

import pytest

pytestmark = pytest.mark.slow

pytest.importorskip("torch")


def load(path):
    """Return a script as a module."""
    spec = importlib.util.spec_from_file_location(f"examples_{path.stem}", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def number(text, pattern):
    return float(re.search(pattern, text)[1])


def test_equations_of_motion_help_a_network(root, run):
    text = run(root / "examples/physics_informed/run.py", "--small").stdout
    assert number(text, r"make the error ([\d.]+) times smaller") > 5
