"""Files of PyTorch may run code when they are loaded: physx does not, and says what to do."""

import shlex
import subprocess
import sys

import numpy as np
import pytest

from physx_core import Dataset
from physx_formats import ExchangeError, import_file

pytestmark = pytest.mark.processes


@pytest.mark.slow
def test_a_file_of_pytorch_is_answered_with_the_line_that_converts_it(tmp_path):
    torch = pytest.importorskip("torch")
    x = torch.arange(6.0).reshape(3, 2)
    torch.save({"x": x}, tmp_path / "run 1.pt")
    with pytest.raises(ExchangeError, match="a file of PyTorch") as found:
        import_file(tmp_path / "run 1.pt", tmp_path / "set")
    command = shlex.split(str(found.value).splitlines()[1])
    assert command[0] == "python"
    subprocess.run([sys.executable, *command[1:]], check=True)
    import_file(tmp_path / "run 1.safetensors", tmp_path / "set")
    with Dataset.open(tmp_path / "set") as dataset:
        assert np.array_equal(dataset["training"]["x"][:], x.numpy())
