"""Each wheel is built and installed into an empty environment, as a user would do it."""

import json
import os
import re
import shutil
import subprocess
import sys
import venv
from pathlib import Path

import filelock
import pytest
from PIL import Image

pytestmark = [pytest.mark.slow, pytest.mark.processes]

PHYSX = ("-m", "physx_core")
GENERATE = "--batch-nb 2 --batch-size 10"
CONSTRAINTS = Path(__file__).parents[2] / "constraints.txt"
OPTIONS = ("--quiet", "--no-compile", "-c", CONSTRAINTS)
WORKSHOP = Path(__file__).parent / "programs" / "physx_workshop"
STUDY = """
[run]
executor = "patient"
[parameters]
"training.network.network_kwargs.net_fields" = [["state", "force"], ["state"]]
[pipelines.linear.training]
epoch_nb = 1
batch_size = 5
[pipelines.linear.training.dataset]
existing_dir = "sessions/data_generation"
view = { folds = 2, fold = 0 }
[pipelines.linear.training.network]
network = "toy/linear"
"""
CRANE = """
<robot name="crane">
  <link name="base"/>
  <link name="hook"><inertial><mass value="2"/>
    <inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <joint name="lift" type="prismatic"><parent link="base"/><child link="hook"/>
    <axis xyz="0 0 1"/><limit lower="0" upper="1" effort="9" velocity="1"/></joint>
</robot>
"""
READ = """
from pathlib import Path
from physx_core.errors import PluginNotFoundError
from physx_core.plugins import resolve
from physx_sim import Box, Robot, UrdfTree, World, parse_urdf

world = World([Robot("crane.urdf")], objects=[Box(name="a box", size=(1, 1, 1))])
links = UrdfTree(parse_urdf(Path("crane.urdf"))).links
print(links[-1], world.objects[0].name, sep=", ")
try:
    resolve("backend", "dart")
except PluginNotFoundError as error:
    print(error)
"""
LOWER = """
from physx_core.plugins import resolve
from physx_sim import JointSettings, Robot, World

crane = Robot("crane.urdf", joints={"lift": JointSettings("velocity")})
with resolve("backend", "mujoco").build(World([crane])) as simulation:
    simulation.set_commands([0.5])
    simulation.step(1000)
    print(f"{simulation.positions()[0]:.1f} m")
"""
ASK = """
import socket, sys
with socket.socket(type=socket.SOCK_DGRAM) as link:
    link.settimeout(10)
    link.sendto(b"1", ("127.0.0.1", int(sys.argv[1])))
    print(link.recv(100).decode(), "reward")
"""
SERVE = """
import threading
from physx_remote import connect, serve

service = serve("CartPole-v1")
threading.Thread(target=service.run, daemon=True).start()
with connect("{}:{}".format(*service.address), token=service.token) as env:
    env.reset(seed=0)
    print(env.step(1)[1], "reward")
"""


@pytest.fixture(scope="module")
def wheels(tmp_path_factory, request):
    """Folder of the wheels, built once for all processes that run tests."""
    root, own = request.config.rootpath, tmp_path_factory.getbasetemp()
    folder = (own.parent if "PYTEST_XDIST_WORKER" in os.environ else own) / "wheels"
    with filelock.FileLock(folder.with_suffix(".lock")):
        if not folder.exists():
            command = [sys.executable, root / ".ci/wheels.py", own / "built"]
            subprocess.run(list(map(str, command)), check=True, capture_output=True)
            (own / "built").rename(folder)
    return folder


@pytest.fixture(scope="module")
def python(tmp_path_factory, wheels):
    """The interpreter of an environment that holds the core alone."""
    folder = tmp_path_factory.mktemp("environment")
    venv.create(folder, with_pip=False)
    pip(folder / "bin/python", "install", *OPTIONS, next(wheels.glob("physx_core-*.whl")))
    return folder / "bin/python"


@pytest.fixture
def add(python, wheels):
    """Install a package beside the core; it goes after the test, with all that came with it."""
    before = installed(python)
    yield lambda name: pip(
        python, "install", *OPTIONS, "--find-links", wheels, next(wheels.glob(f"{name}-*.whl"))
    )
    pip(python, "uninstall", "--quiet", "--yes", *sorted(installed(python) - before))


def pip(python, command, *words):
    """Have the pip of this environment work on another one, which then needs none."""
    line = [sys.executable, "-m", "pip", "--python", python, "--disable-pip-version-check"]
    done = subprocess.run(
        list(map(str, [*line, command, *words])), capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def installed(python):
    """Return the names of all packages of an environment."""
    return {package["name"] for package in json.loads(pip(python, "list", "--format", "json"))}


FC = (
    "torch/fc", "--network.network-kwargs",
    "layers=[2,4,2]", "net_fields='state'", "opt_fields='next_state'",
    "--network.loss", "MSELoss", "--network.optimizer", "Adam",
)  # fmt: skip


def generate(run, python):
    return run(*PHYSX, "generate", "toy/spring", *GENERATE.split(), python=python).stderr


def train(run, python, network, *options, ok=True):
    words = (*PHYSX, "train", "sessions/data_generation", "--epoch-nb", 1, "--batch-size", 5)
    return run(*words, "--network.network", network, *options, python=python, ok=ok).stderr


def test_the_core_alone_generates_and_trains(python, run, wheels):
    folder = run(*PHYSX, "include", python=python).stdout.strip()
    assert {"physx.h", "physx.f90"} < {path.name for path in Path(folder).iterdir()}
    foreign = {"gymnasium", "torch", "dartpy", "pin", "rerun-sdk"}
    assert not foreign & installed(python)
    assert "20 training" in generate(run, python)

    def hint(name):
        return f"pip install {next(wheels.glob(f'{name}-*.whl'))}"

    arguments = ("--network.network-kwargs", "net_fields=['state','force']")
    assert "training loss" in train(run, python, "toy/linear", *arguments)
    assert hint("physx_torch") in train(run, python, *FC, ok=False)
    missing = run(*PHYSX, "generate", "dart/arm", *GENERATE.split(), python=python, ok=False)
    assert missing.returncode == 1 and hint("physx_dart") in missing.stderr
    missing = run(*PHYSX, "serve", python=python, ok=False)
    assert missing.returncode == 1 and hint("physx_remote") in missing.stderr


@pytest.mark.faults
def test_the_demo_from_the_index_makes_a_film(tmp_path, wheels, run):
    venv.create(tmp_path / "environment", with_pip=False)
    python = tmp_path / "environment/bin/python"
    pip(python, "install", *OPTIONS, "--extra-index-url", (wheels / "simple").as_uri(), "physx")
    said = run("demo", python=python.with_name("physx")).stdout
    errors = dict(re.findall(r"^  (PD.*?) +([0-9.]+) mm$", said, re.MULTILINE))
    alone, network, exact = map(float, errors.values())
    assert exact < network < alone / 10
    with Image.open(tmp_path / "physx_demo/film.gif") as film:
        assert film.n_frames > 50
    assert (tmp_path / "physx_demo/arm.py").is_file()
    run("report", "physx_demo/sessions/network", python=python.with_name("physx"))
    assert (tmp_path / "physx_demo/sessions/network/report.html").is_file()


@pytest.mark.faults
def test_torch_adds_its_network(python, add, run):
    generate(run, python)
    add("physx_torch")
    assert "training loss" in train(run, python, *FC)


@pytest.mark.faults
@pytest.mark.parametrize(
    ("name", "command"),
    [
        ("physx_dart", f"generate dart/double-pendulum {GENERATE}"),
        ("physx_rerun", f"generate toy/spring {GENERATE} --environment.visualizer rerun"),
        ("physx_gym", f"generate gym/CartPole-v1 {GENERATE}"),
    ],
)
def test_each_plugin_works_with_the_core_alone(name, command, python, add, run):
    add(name)
    assert "20 training" in run(*PHYSX, *command.split(), python=python).stderr


def test_sim_reads_a_robot_and_has_no_engine(python, add, run, tmp_path):
    add("physx_sim")
    (tmp_path / "crane.urdf").write_text(CRANE)
    (tmp_path / "program.py").write_text(READ)
    done = run("program.py", python=python).stdout
    assert "hook, a box" in done
    assert 'No plugin "dart" is installed' in done and "pip install" in done


@pytest.mark.faults
def test_mujoco_simulates_without_the_other_engines(python, add, run, tmp_path):
    add("physx_mujoco")
    assert not {"dartpy", "pin"} & installed(python)
    (tmp_path / "crane.urdf").write_text(CRANE)
    (tmp_path / "program.py").write_text(LOWER)
    assert "0.5 m" in run("program.py", python=python).stdout


def test_formats_exports_and_imports(python, add, run, tmp_path):
    add("physx_formats")
    generate(run, python)
    run(*PHYSX, "export", "sessions/data_generation", "rows.npz", "--to", "npz", python=python)
    assert "20 training samples" in run(*PHYSX, "import", "rows.npz", "copy", python=python).stdout


def test_testing_writes_a_plugin_and_checks_a_component(python, add, run, tmp_path):
    add("physx_testing")
    run(*PHYSX, "new", "environment", "mine", python=python)
    assert (tmp_path / "physx-mine/pyproject.toml").exists()
    assert "toy/spring" in run(*PHYSX, "check", "toy/spring", python=python).stdout


@pytest.mark.faults
def test_report_writes_a_page(python, add, run):
    add("physx_report")
    generate(run, python)
    assert "report.html" in run(*PHYSX, "report", "sessions/data_generation", python=python).stdout


@pytest.mark.faults
def test_agree_says_which_engine_is_missing(python, add, run):
    add("physx_agree")
    missing = run(*PHYSX, "agree", "physx_gym:physx/Cartpole-v0", python=python, ok=False)
    assert missing.returncode == 1 and "physx_dart" in missing.stderr


@pytest.mark.faults
def test_remote_works_with_the_core_alone(python, add, run, tmp_path):
    add("physx_remote")
    (tmp_path / "program.py").write_text(SERVE)
    assert "1.0 reward" in run("program.py", python=python).stdout


@pytest.mark.faults
def test_the_plugin_of_clusters_works_with_the_core_alone(python, add, run):
    add("physx_cluster")
    words = ("generate", "toy/spring", *GENERATE.split(), "--environment.launcher")
    for name, library in (("cluster/ray", "Ray"), ("cluster/slurm", "submitit")):
        missing = run(*PHYSX, *words, name, python=python, ok=False)
        assert missing.returncode == 1
        assert f"needs {library}" in missing.stderr
        assert "physx_cluster" in missing.stderr and "pip install" in missing.stderr


@pytest.fixture
def workshop(python, add, wheels, tmp_path):
    """Install a package that brings a format, a protocol, an executor, and a kind of its own."""
    for name in ("physx_testing", "physx_formats", "physx_remote", "physx_cluster"):
        add(name)
    source = shutil.copytree(WORKSHOP, tmp_path / "source")
    command = (sys.executable, "-m", "build", "--wheel", "--no-isolation", "-o", tmp_path, source)
    subprocess.run(list(map(str, command)), check=True, capture_output=True)
    pip(python, "install", *OPTIONS, "--no-deps", next(tmp_path.glob("*.whl")))


@pytest.mark.faults
@pytest.mark.usefixtures("workshop")
def test_a_package_adds_components_of_every_kind_and_a_kind_of_its_own(python, run, tmp_path):
    def physx(*words, ok=True):
        return run(*PHYSX, *words, python=python, ok=ok)

    listed = physx("plugins").stdout
    for text in (
        *("format: workshop/columns", "protocol: workshop/datagrams"),
        *("trial_executor: workshop/patient", "material: workshop/steel, workshop/antimatter"),
    ):
        assert text in listed

    generate(run, python)
    physx("export", "sessions/data_generation", "spring.txt", "--to", "columns")
    assert "20 training samples" in physx("import", "spring.txt", "copy").stdout
    physx("export", "sessions/data_generation", "again.txt", "--to", "workshop/columns")
    assert (tmp_path / "again.txt").read_bytes() == (tmp_path / "spring.txt").read_bytes()

    words = [python, *PHYSX, "serve", "CartPole-v1", "--protocol", "datagrams"]
    with subprocess.Popen(words, stdout=subprocess.PIPE, text=True) as service:
        port = service.stdout.readline().split()[-1].rpartition(":")[2]
        assert "1.0 reward" in run("-c", ASK, port, python=python).stdout
        service.terminate()

    (tmp_path / "study.toml").write_text(STUDY)
    assert "2 trials" in physx("sweep", "study.toml").stderr
    assert len((tmp_path / "patient.log").read_text().split()) == 2

    assert physx("weigh", "steel", "2").stdout == "15700 kg\n"
    assert 'Did you mean "steel"' in physx("weigh", "stel", "2", ok=False).stderr
    found = physx("check", "workshop", "--kind", "material", ok=False)
    assert found.returncode == 1
    assert "its density is -1.0 kg/m³" in found.stdout and "1 of 2" in found.stderr
