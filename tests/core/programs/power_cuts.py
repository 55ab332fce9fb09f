"""Power cuts: unshare --mount python power_cuts.py PLACE DURABILITY SEED ROUNDS WORK [WORK ...].

Each writer works on an ext4 file system of its own: an image, mounted. All images lie in one outer
file system, and freezing that is the power cut: what the kernel has written to an image by then,
in the middle of whatever it does, is copied; the caches are not. Each copy is mounted, which
replays its journal, and its files are looked at as after a reboot: they hold what had been promised
by the moment of the cut, and nothing else. Then the writers go on until the next cut.

Rows follow from their numbers. The last line of the output counts the cuts, and says what was
refused, wrong or lost.
"""

import contextlib
import ctypes
import fcntl
import json
import os
import random
import signal
import subprocess
import sys
import time
import traceback
import uuid
import warnings
from pathlib import Path
from types import SimpleNamespace

import numpy as np

from physx_core import Dataset, NetworkConfig, checkpoint
from physx_core.errors import CheckpointError, DatasetError, DatasetNotFoundError

SYNCED = 2.5  # seconds after which the default mode has everything on the disk: two passes
TINY, LARGE = 4e-5, 0.25
FREEZE, THAW, NEW_MOUNTS = 0xC0045877, 0xC0045878, 0x00020000
BOOT_ID = "/proc/sys/kernel/random/boot_id"
MEGABYTES = 256


class Wrong(AssertionError):
    """Values that nobody wrote."""


class Lost(AssertionError):
    """Something is not there that had been promised."""


def demand(condition, error, text):
    if not condition:
        raise error(text)


def expected(n):
    """Rows of a dataset, which follow from their numbers."""
    n = np.asarray(n)
    values = np.sin(n[:, None] * np.arange(1, 31))
    return {"n": n, "x": values, "y": values[:, 0].astype("float32")}


def opened(folder, size, durable):
    if (folder / "dataset.json").exists():
        return Dataset.open(folder, writable=True, max_file_size=size, durable=durable)
    return Dataset.create(folder, max_file_size=size, durable=durable)


# What the writers do ----------------------------------------------------------------------------
#
# Each yields a number that grows, and whether what it stands for is on the disk already, and not
# only in about a second or with durable=True.


def appended(folder, durable, chance, size=LARGE):
    """Append blocks to one dataset."""
    with opened(folder, size, durable) as dataset:
        total = 0
        yield total, True
        while True:
            count = chance.randrange(1, 150)
            dataset.append("training", expected(range(total, total + count)))
            total += count
            yield total, False


def rolled_over(folder, durable, chance):
    """Append to many small partitions."""
    yield from appended(folder, durable, chance, TINY)


def extended(folder, durable, chance):
    """Open, append for a while, and close, again and again."""
    total = 0
    while True:
        end = time.monotonic() + chance.choice((0, 0.1, 1.5)) * chance.random()
        with opened(folder, chance.choice((TINY, LARGE)), durable) as dataset:
            while True:
                count = chance.randrange(1, 80)
                dataset.append("training", expected(range(total, total + count)))
                total += count
                yield total, False
                if time.monotonic() > end:
                    break
        yield total, True


def created(folder, durable, chance):
    """Make one dataset after the other."""
    for number in range(10**6):
        with Dataset.create(folder / str(number), durable=durable) as dataset:
            dataset.append("training", expected(range(7)))
        yield number + 1, True


def described(folder, durable, chance):
    """Replace the manifest, which grows and shrinks."""
    with opened(folder, LARGE, durable) as dataset:
        dataset.append("training", expected(range(100)))
    with opened(folder, LARGE, durable) as dataset:
        for done in range(10**6):
            dataset.update_info(done=done, text="x" * chance.randrange(100_000))
            yield done, True


UPDATED, ADDED = 1500, 150


def update(number):
    """Rows that an update changes, and their new value."""
    chance = random.Random(number)
    first = chance.randrange(UPDATED + ADDED)
    return slice(first, first + chance.randrange(1, 400)), float(number + 1)


def updated(folder, durable, chance):
    """Write rows over others, in sealed partitions and in the open one."""
    for count in (UPDATED, ADDED):
        dataset = opened(folder, 1e-4, durable)
        dataset.append("training", {"x": np.zeros((count, 30)), "n": np.zeros(count)})
        if count == UPDATED:
            dataset.close()
            yield 0, True
    yield 1, False
    for number in range(10**6):
        where, value = update(number)
        count = len(range(UPDATED + ADDED)[where])
        rows = {"x": np.full((count, 30), value), "n": np.full(count, value)}
        dataset.update("training", where, rows)
        yield number + 2, False


MERGED = range(10**6, 10**6 + 200)


def curation(steps):
    """Partitions after so many steps of `curated`, and the next step: number to rows' numbers."""
    parts, step, used = {}, None, 0
    for number in range(steps + 1):
        if number:
            kind, what = step
            if kind == "remove":
                del parts[what]
            else:
                for rows in what:
                    parts[used] = rows
                    used += 1
        chance = random.Random(number)
        kind = chance.choice(("append", "append", "merge", "remove"))
        if len(parts) > 12 or (kind == "remove" and parts):
            step = "remove", chance.choice(sorted(parts))
        elif kind == "merge":
            step = "merge", [MERGED[:150], MERGED[150:]]
        else:
            first = 1000 * number
            step = "append", [range(first, first + chance.randrange(1, 60))]
    return parts, step


def curated(folder, durable, chance):
    """Append, merge, and remove partitions."""
    other = folder.with_name("other")
    for rows in (MERGED[:150], MERGED[150:]):
        with opened(other, LARGE, durable) as dataset:
            dataset.append("training", expected(rows))
    opened(folder, LARGE, durable).close()
    for number in range(10**6):
        kind, what = curation(number)[1]
        with opened(folder, LARGE, durable) as dataset:
            if kind == "append":
                dataset.append("training", expected(what[0]))
            elif kind == "merge":
                dataset.merge(other)
                yield number + 1, True
            else:
                dataset.remove_partition("training", what)
                yield number + 1, True
        yield number + 1, True


def parameters(number):
    return np.random.default_rng(number).bytes(300_000)


def saved(folder, durable, chance):
    """Write checkpoints, and replace the best one."""
    for number in range(10**6):
        network = SimpleNamespace(
            parameters_file="parameters.safetensors", net_fields=[], opt_fields=[],
            save_parameters=lambda path, number=number: path.write_bytes(parameters(number)),
        )  # fmt: skip
        optimization = SimpleNamespace(
            state_file="optimization.safetensors",
            save_state=lambda path, number=number: path.write_bytes(parameters(number)[:1000]),
        )
        progress = checkpoint.Progress(number, 0, 0, 1)
        what = folder, NetworkConfig("torch/fc"), network, optimization, {}, {}, progress
        for best in (False, True):
            checkpoint.save(*what, best=best)
            yield 2 * number + best + 1, True
        time.sleep(0.1)


# What has to be there after a cut ---------------------------------------------------------------


def compare(dataset, n):
    """Check that a dataset has the rows of these numbers."""
    for name, values in expected(n).items() if len(n) else ():
        demand(np.array_equal(dataset["training"][name][:], values), Wrong, f"rows of {name}")
        if name == "x":
            mean = dataset.normalization[name].mean
            demand(np.allclose(mean, values.mean(axis=0), atol=1e-9), Wrong, "the mean")


def check_writing(folder, n, durable):
    """Go on with a dataset whose rows have these numbers."""
    n = list(n)
    with opened(folder, LARGE, durable) as dataset:
        compare(dataset, n)
        dataset.append("training", expected([77, 78]))
    with Dataset.open(folder) as dataset:
        compare(dataset, [*n, 77, 78])
        problems = dataset.verify()
        demand(problems == [], Wrong, f"verify: {problems}")


def check_appended(folder, durable, promised, told):
    try:
        with Dataset.open(folder) as dataset:
            total = dataset.num_samples("training")
            compare(dataset, range(total))
            dataset.verify()
    except DatasetNotFoundError:
        total = 0
        demand(promised < 0, Lost, "the dataset")
    demand(total >= promised, Lost, f"{promised - total} of {promised} rows")
    check_writing(folder, range(total), durable)


def check_created(folder, durable, promised, told):
    for number in range(max(0, promised - 3), told + 2):
        place = folder / str(number)
        try:
            with Dataset.open(place) as dataset:
                total = dataset.num_samples("training")
        except DatasetNotFoundError:
            demand(number >= promised, Lost, f"dataset {number}")
            total = 0
        demand(total == 7 or number >= promised, Lost, f"{7 - total} of 7 rows")
        check_writing(place, range(total), durable)


def check_described(folder, durable, promised, told):
    if promised < 0 and not (folder / "dataset.json").exists():
        return
    with Dataset.open(folder) as dataset:
        done = dataset.info.get("done", -1)
        demand(promised <= done <= told + 1, Lost, f"info {promised}: there is {done}")
        total = dataset.num_samples("training")
        demand(total == 100 or promised < 0, Lost, f"{100 - total} of 100 rows")
        compare(dataset, range(total))
    check_writing(folder, range(total), durable)


def possible(found, promised, told):
    """Return which values an update may have left, of those that were promised or under way."""
    old = np.zeros(UPDATED + ADDED)
    for number in range(promised):
        where, value = update(number)
        old[where] = value
    old = old[: len(found)].reshape(-1, *[1] * (found.ndim - 1))
    good = found == old
    for number in range(promised, told + 1):
        where, value = update(number)
        good[where] |= found[where] == value
    return good, old


def check_updated(folder, durable, promised, told):
    if promised < 0 and not (folder / "dataset.json").exists():
        return
    for writable in (False, True, False):
        with Dataset.open(folder, writable=writable) as dataset:
            total = dataset.num_samples("training")
            least = UPDATED * (promised >= 0) + ADDED * (promised >= 1)
            demand(total >= least, Lost, f"{least - total} of {least} rows")
            for name in ("n", "x") if total else ():
                found = dataset["training"][name][:]
                good, old = possible(found, max(0, promised - 1), max(0, told))
                bad = np.argwhere(~good)
                if len(bad):
                    is_old = (found[~good] < np.broadcast_to(old, found.shape)[~good]).all()
                    what = f"{len(bad)} values of {name}, the first at {bad[0]}"
                    raise (Lost if is_old else Wrong)(what)
            if not writable:
                problems = dataset.verify()
            elif total:
                dataset.update("training", 0, {"n": dataset["training"]["n"][0]})
    demand(problems == [], Wrong, f"verify: {problems}")


def check_curated(folder, durable, promised, told):
    if promised < 0:
        return
    with Dataset.open(folder) as dataset:
        n = dataset["training"]["n"][:].tolist() if dataset.modes else []
        states = [curation(number)[0].values() for number in range(promised, told + 2)]
        states = [[n for rows in state for n in rows] for state in states]
        demand(n in states, Lost, f"state {promised}: there are {len(n)} rows")
        compare(dataset, n)
    check_writing(folder, n, durable)


def check_saved(folder, durable, promised, told):
    best = promised // 2 - 1
    for which in [*range((promised + 1) // 2), *(["best"] if best >= 0 else ())]:
        try:
            found = checkpoint.find(folder, "network", which)
        except CheckpointError as error:
            raise Lost(str(error)) from error
        epoch, content = found.progress.epoch, (found.path / "parameters.safetensors").read_bytes()
        right = epoch in (best, best + 1) if which == "best" else epoch == which
        demand(right, Lost, f"checkpoint {which} is of epoch {epoch}")
        demand(content == parameters(epoch), Wrong, f"parameters of checkpoint {which}")


WORKS = {
    "append": (appended, check_appended),
    "roll-over": (rolled_over, check_appended),
    "extend": (extended, check_appended),
    "create": (created, check_created),
    "info": (described, check_described),
    "update": (updated, check_updated),
    "curate": (curated, check_curated),
    "checkpoint": (saved, check_saved),
}


# Disks and cuts ---------------------------------------------------------------------------------


def run(*command):
    subprocess.run(list(map(str, command)), check=True, stdin=subprocess.DEVNULL)


def mount(image, place, *options):
    place.mkdir(exist_ok=True)
    run("mount", "-o", ",".join(("loop", *options)), image, place)


def make_disk(image, nbytes, *options):
    with image.open("wb") as file:
        file.truncate(nbytes)
    run("mkfs.ext4", "-q", "-F", "-b", 4096, *options, image)


class Writer:
    """A process that works on a disk of its own."""

    def __init__(self, place, number, work, durable, seed):
        self.work, self.durable, self.number = work, durable, number
        self.image = place / "outer" / f"{number}.img"
        self.copy = place / f"{number}.img"
        self.after = place / f"after_{number}"
        self._told = place / f"told_{number}"
        self._pauses = []
        make_disk(self.image, MEGABYTES * 2**20, "-N", 8192)
        disk = place / f"disk_{number}"
        mount(self.image, disk, f"commit={random.Random(seed).choice((1, 5, 5, 30))}")
        self._told.touch()
        self.process = os.fork()
        if not self.process:
            with self._told.open("w") as told:
                try:
                    chance = random.Random(seed)
                    for event in WORKS[work][0](disk / "data", durable, chance):
                        print(json.dumps((time.monotonic(), *event)), file=told, flush=True)
                        time.sleep(chance.uniform(0, 0.03))
                except BaseException:
                    traceback.print_exc()
                finally:
                    sys.stderr.flush()
                    os._exit(1)

    def stop(self):
        os.kill(self.process, signal.SIGSTOP)
        _, status = os.waitpid(self.process, os.WUNTRACED)
        assert os.WIFSTOPPED(status), f"the writer {self.work} failed"

    def go_on(self, since):
        self._pauses.append((since, time.monotonic()))
        os.kill(self.process, signal.SIGCONT)

    def end(self):
        with contextlib.suppress(ProcessLookupError):
            os.kill(self.process, signal.SIGKILL)
            os.waitpid(self.process, 0)

    def promises(self, now):
        """Return the largest number that is promised at a moment, and the largest told at all."""
        events = [json.loads(line) for line in self._told.read_text().splitlines()]
        promised = told = -1
        for then, number, certain in events:
            told = number
            age = now - then - sum(stop - start for start, stop in self._pauses if start > then)
            if (age >= 0 and (certain or self.durable)) or age > SYNCED:
                promised = number
        return promised, told

    def examine(self, now):
        """Start a process that looks at the copy; return it, and where its result will be read."""
        promised, told = self.promises(now)
        reading, writing = os.pipe()
        process = os.fork()
        if not process:
            try:
                result = self._examined(promised, told)
                os.write(writing, json.dumps(result).encode())
                os._exit(0)
            finally:
                traceback.print_exc()
                sys.stderr.flush()
                os._exit(1)
        os.close(writing)
        return process, os.fdopen(reading, "rb")

    def _examined(self, promised, told):
        warnings.simplefilter("ignore")
        assert ctypes.CDLL(None).unshare(NEW_MOUNTS) == 0
        mount(self.copy, self.after)
        run("mount", "--bind", self.after.with_name("boot_id"), BOOT_ID)
        result = {"work": self.work, "promised": promised, "told": told, "outcome": "good"}
        try:
            WORKS[self.work][1](self.after / "data", self.durable, promised, told)
        except DatasetError as error:
            result |= {"outcome": "refused", "what": str(error)}
        except Wrong as error:
            result |= {"outcome": "wrong", "what": str(error)}
        except Lost as error:
            result |= {"outcome": "lost", "what": str(error)}
        return result


def cut(place, writers, chance):
    """Copy what is on the disks at one moment; return what is found in the copies."""
    stopped = [writer for writer in writers if chance.random() < 0.5]
    for writer in stopped:
        writer.stop()
    outer = os.open(place / "outer", os.O_RDONLY)
    now = time.monotonic()
    fcntl.ioctl(outer, FREEZE, 0)
    try:
        for writer in writers:
            run("cp", "--sparse=always", writer.image, writer.copy)
    finally:
        fcntl.ioctl(outer, THAW, 0)
        os.close(outer)
    for writer in writers:
        if writer not in stopped:
            writer.stop()
    results, waiting = [], list(writers)
    while waiting:
        started = [writer.examine(now) for writer in waiting[:2]]
        del waiting[:2]
        for process, pipe in started:
            with pipe:
                content = pipe.read()
            _, status = os.waitpid(process, 0)
            assert status == 0, "looking at a copy failed"
            results.append(json.loads(content))
    for writer in writers:
        writer.go_on(now)
        writer.copy.unlink()
    return results


def main(place, durability, seed, rounds, works):
    durable, chance = durability == "durable", random.Random(seed)
    place.mkdir(exist_ok=True)
    run("mount", "-t", "tmpfs", "tmpfs", place)
    (place / "boot_id").write_text(f"{uuid.uuid4()}\n")
    make_disk(place / "outer.img", len(works) * MEGABYTES * 2**21, "-O", "^has_journal")
    mount(place / "outer.img", place / "outer")
    writers, results = [], []
    try:
        for number, work in enumerate(works):
            writers.append(Writer(place, number, work, durable, seed + number))
        for number in range(rounds):
            time.sleep(chance.uniform(0, 4) if number else chance.uniform(0, 1))
            results += cut(place, writers, chance)
    finally:
        for writer in writers:
            writer.end()
    bad = [result for result in results if result["outcome"] != "good"]
    counts = {"cuts": len(results)}
    for outcome in ("refused", "wrong", "lost"):
        counts[outcome] = sum(result["outcome"] == outcome for result in results)
    print(json.dumps(counts | {"most": max(r["promised"] for r in results), "bad": bad}))


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2], int(sys.argv[3]), int(sys.argv[4]), sys.argv[5:])
