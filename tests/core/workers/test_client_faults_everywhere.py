"""ClientSource: each way in which a client can break, at each place of its life.

The environment `Faulty` of the second of two clients breaks. Rows are stored as a pipeline does it.
"""

from __future__ import annotations

import contextlib
import itertools
import re
import time
from pathlib import Path

import pytest

from physx_core import Dataset, PhysxError
from physx_core.errors import ClientError, EnvironmentFailedError

pytestmark = pytest.mark.processes

PLACES = ["create", "init_database", "step", "prediction", "close"]
TEXTS = {
    "raise": r"Instance 2 raised in \w+\(\).*: RuntimeError: no more beans",
    "exit": "Client 2 ended with exit status 3 after",
    "kill": r"Client 2 was killed by signal 9 \(SIGKILL\) after",
    "stop": r"Client 2 sent nothing for [\d.]+ s while the server waited for it",
    "spin": r"Client 2 sent nothing for [\d.]+ s while the server waited for it",
    "garbage": r"Client 2 was cut off after \d+ rows\. .*not a physx message",
    "half": r"Client 2 sent nothing for [\d.]+ s while the server waited for it",
    "dribble": r"Client 2 sent nothing for [\d.]+ s while the server waited for it",
    "trickle": r"Client 2 sent nothing for [\d.]+ s while the server waited for it",
    "disconnect": r"Client 2 closed the connection after",
}
ALWAYS = {
    ("raise", "prediction"),
    ("exit", "init_database"),
    ("kill", "prediction"),
    ("spin", "create"),
    ("garbage", "step"),
    ("half", "prediction"),
    ("trickle", "step"),
    ("disconnect", "step"),
}
HANGS = ("stop", "spin", "half", "dribble", "trickle")
BATCHES = 5
SOON = 30.0  # far below the 60 s for which a client may be silent


@pytest.fixture
def batch_services(services):
    """The services, predicting several samples at once: whoever asks waits for the others."""
    services.predict_batch = lambda batch: {"y": 2 * batch["x"]}
    return services


def broken_run(source, folder):
    """Store rows until an error comes; return it, and when it came and all was cleared away.

    Times are in s since the client broke.
    """
    with (
        Dataset.create(folder) as dataset,
        pytest.raises(PhysxError) as caught,
        contextlib.closing(source),
    ):
        try:
            source.open()
            for _ in range(BATCHES):
                batch = source.batch(4)
                dataset.define_fields("training", source.fields)
                dataset.append("training", batch)
            source.close()
        except PhysxError:
            came = time.monotonic()
            raise
    cleared = time.monotonic()
    broke = float(Path("broke").read_text())
    return caught.value, came - broke, cleared - broke


def check_rows(folder, count):
    """Check that the dataset is sound and holds the first rows that the environments made."""
    with Dataset.open(folder) as dataset:
        assert dataset.verify() == []
        assert dataset.num_samples("training") == count
        if count:
            rows = dataset["training"]
            expected = [(row % 2 + 1, row // 2) for row in range(count)]
            assert rows["x"][:].tolist() == [list(map(float, one)) for one in expected]
            assert rows["env_id"][:].tolist() == [instance for instance, _ in expected]
            assert rows["step"][:].tolist() == [step for _, step in expected]


CASES = [
    pytest.param(*case, marks=() if case in ALWAYS else pytest.mark.faults)
    for case in itertools.product(TEXTS, PLACES)
]


@pytest.mark.parametrize(("fault", "place"), CASES)
def test_client_fault_is_reported_with_client(
    clients, batch_services, folder, fault, place, record_property, unhurried
):
    hangs = fault in HANGS
    timeout = unhurried(3.0) if hangs else 60.0
    source = clients(
        "Faulty",
        num_clients=2,
        run_ahead=0,
        env_kwargs={"fault": fault, "place": place},
        timeout=timeout,
    )
    error, came, cleared = broken_run(source, folder)
    record_property("seconds", (came, cleared))

    assert re.search(TEXTS[fault], str(error)), error
    assert error.instance_id == 2
    if fault == "raise":
        assert isinstance(error, EnvironmentFailedError)
        assert error.method == ("step" if place == "prediction" else place)
        assert error.step == {"step": 5, "prediction": 5}.get(place, -1)
        assert 'raise RuntimeError("no more beans")' in error.remote_traceback
    else:
        assert isinstance(error, ClientError)
        assert error.exit_status == {"exit": 3, "kill": -9}.get(fault)
        assert "last words" in error.stderr
        assert "last words" in str(error)
        assert (f"in do_{fault}" in error.stderr) == (hangs and fault != "stop")
    assert came < (timeout if hangs else 0.0) + SOON
    assert cleared < (timeout if hangs else 0.0) + SOON
    check_rows(folder, {"step": 8, "prediction": 8, "close": 4 * BATCHES}.get(place, 0))
