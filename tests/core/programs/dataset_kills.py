"""Writers killed at random moments: python dataset_kills.py FOLDER WORK DURABILITY SEED KILLS.

Each writer is a process of its own, forked so that hundreds can be started in a minute. It tells
through a pipe what it has committed; whoever kills it then looks at what is left: all of that, and
nothing else. The last line of the output counts the kills and the rows that were found again.
"""

import json
import os
import random
import signal
import sys
import time
from pathlib import Path

import h5py
import numpy as np

from physx_core import Dataset
from physx_core.errors import DatasetNotFoundError

PER_FOLDER = 3  # later kills hit a dataset that was extended after the first one
SIZES = {"append": 0.25, "roll-over": 4e-5, "update": 1e-4}
UPDATED = 2000


def expected(count, first=0):
    """Rows of a dataset, which follow from their numbers."""
    rows = np.arange(first, first + count)
    values = np.sin(rows[:, None] * np.arange(1, 31))
    return {"n": rows, "x": values, "y": values[:, 0].astype("float32")}


def operation(number):
    """Rows that an update changes, and their new value."""
    chance = random.Random(number)
    first = chance.randrange(UPDATED)
    return slice(first, first + chance.randrange(1, 900)), float(number + 1)


# What the writers do: each yields how much is committed ------------------------------------------


def opened(folder, work, durable):
    options = {"max_file_size": SIZES.get(work, 0.25), "durable": durable}
    if (folder / "dataset.json").exists():
        return Dataset.open(folder, writable=True, **options)
    return Dataset.create(folder, **options)


def appended(folder, work, durable, chance):
    """Append blocks to one dataset, in few large or many small partitions."""
    dataset = opened(folder, work, durable)
    total = dataset.num_samples("training")
    while True:
        count = chance.randrange(1, 400)
        dataset.append("training", expected(count, total))
        total += count
        yield total


def sealed(folder, work, durable, chance):
    """Open, append and close, again and again; the first time is the creation."""
    while True:
        with opened(folder, work, durable) as dataset:
            total = dataset.num_samples("training")
            count = chance.randrange(1, 50)
            dataset.append("training", expected(count, total))
            yield total + count


def created(folder, work, durable, chance):
    """Make one dataset after the other."""
    for number in range(len(list(folder.iterdir())), 10**6):
        with Dataset.create(folder / str(number), durable=durable) as dataset:
            dataset.append("training", expected(7))
            yield number


def described(folder, work, durable, chance):
    """Replace the manifest, which grows and shrinks."""
    with opened(folder, work, durable) as dataset:
        if not dataset.modes:
            dataset.append("training", expected(100))
        done = dataset.info.get("done", 0)
        while True:
            done += 1
            dataset.update_info(done=done, text="x" * chance.randrange(100_000))
            yield done


def updated(folder, work, durable, chance):
    """Write rows over others, also of sealed partitions."""
    with opened(folder, work, durable) as dataset:
        if not dataset.modes:
            dataset.append("training", {"x": np.zeros((UPDATED, 30)), "n": np.zeros(UPDATED)})
            dataset.update_info(written=True)
        done = int(dataset["training"]["n"][:].max())
        while True:
            where, value = operation(done)
            count = len(range(UPDATED)[where])
            values = {"x": np.full((count, 30), value), "n": np.full(count, value)}
            dataset.update("training", where, values)
            done += 1
            yield done


WORKS = {
    "create": created,
    "append": appended,
    "roll-over": appended,
    "seal": sealed,
    "json": described,
    "update": updated,
}


def killed(folder, work, durable, chance):
    """Run a writer, kill it, and return the last number that it told, or -1."""
    reading, writing = os.pipe()
    seed = chance.random()
    writer = os.fork()
    if not writer:
        os.close(reading)
        try:
            for number in WORKS[work](folder, work, durable, random.Random(seed)):
                os.write(writing, b"%d\n" % number)
        finally:
            os._exit(1)
    os.close(writing)
    with os.fdopen(reading, "rb") as pipe:
        first = pipe.readline() if work not in ("create", "seal") else b"-1\n"
        time.sleep(chance.uniform(0, 0.05))
        os.kill(writer, signal.SIGKILL)
        told = (first + pipe.read()).split(b"\n")[-2]
    _, status = os.waitpid(writer, 0)
    assert os.WIFSIGNALED(status) and os.WTERMSIG(status) == signal.SIGKILL, "the writer failed"
    return int(told)


# What has to be left ----------------------------------------------------------------------------


def check_h5py(folder):
    for path in folder.rglob("*_*.h5"):
        with h5py.File(path) as file:
            assert 0 <= file["rows"][()] <= len(file["data"])


def check_rows(folder, least):
    """Check all rows, and return how many there are."""
    with Dataset.open(folder) as dataset:
        total = dataset.num_samples("training")
        assert total >= least, f"{least - total} of {least} rows are lost"
        if total:
            rows = expected(total)
            for name, values in rows.items():
                np.testing.assert_array_equal(dataset["training"][name][:], values)
            mean = dataset.normalization["x"].mean
            np.testing.assert_allclose(mean, rows["x"].mean(axis=0), atol=1e-9)
        assert dataset.verify() == []
    return total


def check_appended(folder, work, durable, told):
    try:
        total = check_rows(folder, told)
    except DatasetNotFoundError:
        assert told < 0
        total = 0
    with opened(folder, work, durable) as dataset:  # the next run goes on
        dataset.append("training", expected(3, total))
    assert check_rows(folder, total + 3) == total + 3
    return max(told, 0)


def check_created(folder, work, durable, told):
    for number in range(max(0, told), told + 2):
        place = folder / str(number)
        try:
            assert check_rows(place, 7 if number <= told else 0) in (0, 7)
        except DatasetNotFoundError:
            assert number > told
        with opened(place, work, durable) as dataset:
            if not dataset.modes or not dataset.num_samples("training"):
                dataset.append("training", expected(7))
        assert check_rows(place, 7) == 7
    return 7 * (told + 1)


def check_described(folder, work, durable, told):
    with Dataset.open(folder) as dataset:
        assert told <= dataset.info["done"] <= told + 1
        assert set(dataset.info["text"]) <= {"x"}
    assert check_rows(folder, 100) == 100
    Dataset.open(folder, writable=True).close()
    assert check_rows(folder, 100) == 100
    return 100


def check_updated(folder, work, durable, told):
    """Check that each value is what the last update made it, or else the one that was cut off."""
    old = np.zeros(UPDATED)
    for number in range(told):
        where, value = operation(number)
        old[where] = value
    new = old.copy()
    where, value = operation(told)
    new[where] = value
    for _ in range(2):
        with Dataset.open(folder) as dataset:
            assert dataset.verify() == []
            x, n = dataset["training"]["x"][:], dataset["training"]["n"][:]
            assert ((n == old) | (n == new)).all()
            assert ((x == old[:, None]) | (x == new[:, None])).all()
            mean = dataset.normalization["x"].mean
            np.testing.assert_allclose(mean, x.mean(axis=0), atol=1e-9)
        # What was cut off is done again, which makes the state certain for the next kill.
        with Dataset.open(folder, writable=True) as dataset:
            dataset.update("training", where, {"x": np.full_like(x[where], value)})
            dataset.update("training", where, {"n": np.full_like(n[where], value)})
        old = new
    return UPDATED


CHECKS = {
    "create": check_created,
    "append": check_appended,
    "roll-over": check_appended,
    "seal": check_appended,
    "json": check_described,
    "update": check_updated,
}


def main(place, work, durable, seed, kills):
    chance, rows = random.Random(seed), 0
    for trial in range(kills):
        folder = place / str(trial // PER_FOLDER)
        folder.mkdir(exist_ok=True, parents=True)
        told = killed(folder, work, durable, chance)
        check_h5py(folder)
        rows += CHECKS[work](folder, work, durable, told)
    print(json.dumps({"kills": kills, "committed rows, all found": rows}))


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2], sys.argv[3] == "durable", *map(int, sys.argv[4:6]))
