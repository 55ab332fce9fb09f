"""What all tests share."""

import contextlib
import datetime
import itertools
import os
import platform
import random
import shutil
import signal
import socket
import subprocess
import sys
import time
import uuid
from multiprocessing import resource_tracker
from pathlib import Path

import pytest
import sizes
from hypothesis import HealthCheck, settings

# Else each of the thousands of interpreters that tests start compiles all of physx again.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
sys.dont_write_bytecode = False

# The processors are busy with other tests: more threads would only be in their way.
os.environ.setdefault("OMP_NUM_THREADS", "1")

# Tests write gigabytes, most of them synced: in memory, where there is room for them.
MEMORY = Path("/dev/shm")
if (
    MEMORY.is_dir()
    and shutil.disk_usage(MEMORY).free > 8 << 30
    and not os.statvfs(MEMORY).f_flag & os.ST_NOEXEC
):
    os.environ.setdefault("PYTEST_DEBUG_TEMPROOT", str(MEMORY))

# How long an example takes says nothing on a busy machine.
settings.register_profile("physx", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.register_profile("quick", settings.get_profile("physx"), max_examples=10)

# A shell that starts the tests in the background has them ignore Ctrl-C, and every process that
# they start inherits that; some tests press it.
signal.signal(signal.SIGINT, signal.default_int_handler)


APART = "pytest.mark.processes"  # in a file whose tests start processes
STARTS = ("subprocess.Popen", "os.fork", "os.forkpty", "os.posix_spawn", "os.system")
RUNNING = {"quick": False}  # what kind of test
DAYS, SLOW = 11, 4
"""In how many parts cases and slow tests are; in the days of their product all had a turn."""


def pytest_addoption(parser):
    parser.addoption("--quick", action="store_true", help="only tests that start no process")


def pytest_configure(config):
    """Choose sizes; processes of pytest-xdist inherit the choice as environment variables."""
    os.environ.setdefault("PHYSX_CAMPAIGN", str(datetime.date.today().toordinal()))
    if config.args_source is config.ArgsSource.TESTPATHS and not hasattr(config, "workerinput"):
        os.environ["PHYSX_TEST_SAMPLE"] = "1"
    if config.getoption("quick"):
        os.environ["PHYSX_TEST_QUICK"] = "1"
    platform.processor()  # h5py asks for it, and the first time it starts a process
    sys.addaudithook(refuse_processes)
    settings.load_profile("quick" if sizes.is_quick() else "physx")


def pytest_report_header():
    return f"PHYSX_CAMPAIGN={sizes.campaign()} chose the cases; PHYSX_CAMPAIGN=full has them all"


def pytest_runtest_setup(item):
    os.environ["COLUMNS"] = "1000"  # tests look for sentences: what is printed has whole lines
    RUNNING["quick"] = not any(map(item.get_closest_marker, ("processes", "slow", "faults")))


def refuse_processes(event, _):
    """Fail a test that starts a process although --quick runs it, in any run."""
    phase = os.environ.get("PYTEST_CURRENT_TEST", "").rpartition(" ")[2]
    if event in STARTS and RUNNING["quick"] and phase == "(call)":
        pytest.fail(f"this test starts a process: its file needs pytestmark = {APART}")


def pytest_ignore_collect(collection_path, config):
    """Leave out files by their text: to import them takes most of the time."""
    is_test = config.getoption("quick") and collection_path.suffix == ".py"
    return True if is_test and APART in collection_path.read_text() else None


def pytest_make_parametrize_id(val, argname):
    """Name long values by their argument: some differ between processes, as archives with times."""
    return argname if isinstance(val, str | bytes) and len(val) > 60 else None


def pytest_itemcollected(item):
    """Let pytest-xdist run a file, or all that need a cluster, in one process, one by one."""
    clusters = [name for name in ("ray_cluster", "slurm") if name in item.fixturenames]
    item.add_marker(pytest.mark.xdist_group([*clusters, str(item.path)][0]))


@pytest.hookimpl(trylast=True)  # of what -m and -k have left
def pytest_collection_modifyitems(config, items):
    """Take a sample if the whole suite runs, and begin with files that have long tests."""
    if "PHYSX_TEST_SAMPLE" in os.environ or sizes.is_quick():
        chosen = sampled(items)
        config.hook.pytest_deselected(items=[item for item in items if item not in chosen])
        items[:] = [item for item in items if item in chosen]
    long = {item.path for item in items if any(map(item.get_closest_marker, ("faults", "slow")))}
    items.sort(key=lambda item: item.path not in long)


def sampled(items):
    """Return a sample, another one each day: after some days, all cases had their turn.

    Of tests marked `faults` it is a part; of the cases of each other parametrized test that starts
    processes, or of any in a run of quick tests, another part, or one; and of those of them that
    are marked `slow` a part again.
    """
    faults = [item for item in items if item.get_closest_marker("faults")]
    known = set(faults)
    others, slow = [], []
    rest = (item for item in items if item not in known)
    for _, group in itertools.groupby(rest, key=lambda item: item.nodeid.partition("[")[0]):
        cases = list(group)
        parts = DAYS if sizes.is_quick() or cases[0].get_closest_marker("processes") else 1
        for item in sizes.share(cases, min(parts, len(cases))):
            (slow if item.get_closest_marker("slow") else others).append(item)
    return {*sizes.share(faults, DAYS), *others, *sizes.share(slow, SLOW)}


@pytest.fixture
def port():
    """A port where nobody listens, and which no connection of another test is given by itself."""
    while True:
        number = random.randrange(20_000, 32_000)
        with contextlib.suppress(OSError), socket.create_server(("0.0.0.0", number)):
            return number


class Machine:
    """A network namespace, connected by a bridge in another one, as by a cable and a switch.

    Attributes:
        prefix: What a command begins with to run there.
        address: Our address as seen from there.
        own: Its own address.
    """

    def __init__(self):
        self._name, self._net = f"physx{os.getpid() % 10000}", f"10.203.{os.getpid() % 250}"
        self.prefix = ["ip", "netns", "exec", self._name]
        self.address, self.own = f"{self._net}.1", f"{self._net}.2"

    def connect(self):
        n, switch = self._name, f"{self._name}s"
        steps = [
            f"ip netns add {n}",
            f"ip netns add {switch}",
            f"ip link add {n}a type veth peer name {n}b netns {switch}",
            f"ip -n {switch} link add {n}c type veth peer name {n}d netns {n}",
            f"ip -n {switch} link add {n}e type bridge",
            *(f"ip -n {switch} link set {n}{port} master {n}e" for port in "bc"),
            *(f"ip -n {switch} link set {n}{port} up" for port in "bce"),
            f"ip addr add {self.address}/24 dev {n}a",
            f"ip link set {n}a up",
            f"ip -n {n} addr add {self.own}/24 dev {n}d",
            *(f"ip -n {n} link set {device} up" for device in (f"{n}d", "lo")),
        ]
        for step in steps:
            done = subprocess.run(step.split(), capture_output=True, text=True, check=False)
            if done.returncode:
                pytest.skip(f"{step}: {done.stderr.strip()}")

    def unplug(self):
        """Pull the cable: neither side hears of the other any more, or of the end."""
        step = f"ip -n {self._name}s link set {self._name}c nomaster"
        subprocess.run(step.split(), check=True)

    def remove(self):
        # With its namespace it would go some time later, and be in the way of the next test.
        subprocess.run(["ip", "link", "del", f"{self._name}a"], capture_output=True, check=False)
        for name in (self._name, f"{self._name}s"):
            subprocess.run(["ip", "netns", "del", name], capture_output=True, check=False)


@pytest.fixture
def another_machine():
    """A machine on the network; the test is skipped where none can be made."""
    if shutil.which("ip") is None:
        pytest.skip("the command ip (iproute2) is not installed")
    machine = Machine()
    try:
        machine.connect()
        yield machine
    finally:
        machine.remove()


@pytest.fixture
def nothing_stays_behind(monkeypatch):
    """Every process that the test starts, directly or not, is gone when it ends."""
    resource_tracker.ensure_running()  # which lives as long as this process
    mark, before = uuid.uuid4().hex, running_children()
    monkeypatch.setenv("PHYSX_TEST_MARK", mark)
    yield
    deadline = time.monotonic() + 60  # a process that is killed takes a moment to go
    while (left := marked(mark.encode())) and time.monotonic() < deadline:
        time.sleep(0.05)
    assert not left
    assert running_children() <= before  # nor is there one that nobody waited for


def running_children():
    """Return the process ids of the children of this process, also of those that ended."""
    found = set()
    for each in (folder / "children" for folder in Path("/proc/self/task").glob("*")):
        with contextlib.suppress(OSError):  # the thread has ended
            found.update(map(int, each.read_text().split()))
    return found


@pytest.fixture
def children():
    """The function that returns the children of this process."""
    return running_children


def marked(mark):
    """Command lines of the other processes with a mark in their environment."""
    found = []
    for environ in (folder / "environ" for folder in Path("/proc").glob("[0-9]*")):
        try:
            if mark in environ.read_bytes() and int(environ.parent.name) != os.getpid():
                found.append((environ.parent / "cmdline").read_bytes())
        except OSError:
            continue
    return found


@pytest.fixture
def drive():
    """Bring an environment to life as a pipeline does, step it, and return its samples."""
    alive = []

    def make(environment, **options):
        made = environment(**{"seed": 3, **options})
        alive.append(made)
        made.create()
        made.init()
        made.init_database()
        return made

    def run(environment, steps, predict=None, **options):
        made = make(environment, **options) if isinstance(environment, type) else environment
        samples = []
        for _ in range(steps):
            made.step()
            samples.append(made.take_sample())
            assert made.check_sample()
            if made.factory.has_events:
                made.update_visualization()
            made.step_index += 1
            if predict is not None:
                made.apply_prediction(predict(samples[-1]))
        return samples

    run.make = make
    yield run
    for made in alive:
        made.close()


@pytest.fixture
def folder(tmp_path):
    return tmp_path / "data"


@pytest.fixture
def small_disk(tmp_path):
    """An 8 MB disk."""
    place = tmp_path / "disk"
    place.mkdir()
    mounted = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=8m", "tmpfs", str(place)], capture_output=True
    )
    if mounted.returncode and os.environ.get("CI") != "true":
        pytest.skip("no right to mount a small disk here")
    assert not mounted.returncode, mounted.stderr
    yield place
    subprocess.run(["umount", str(place)], check=True)
