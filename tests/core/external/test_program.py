"""Environments whose samples come from programs in C and Fortran."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import pytest

from physx_core import (
    DataGeneration,
    Dataset,
    EnvironmentConfig,
    NetworkConfig,
    Training,
)
from physx_core.cli import main
from physx_core.errors import (
    ConfigError,
    MissingFieldError,
    NotFiniteError,
    ProgramError,
    SampleError,
)
from physx_core.pipelines import load_learner

pytestmark = pytest.mark.processes

SOURCES = Path(__file__).parents[1] / "programs" / "external"
SIZE, STEPS = 5, 3


def run(source, *sizes):
    """Return all rows of an environment's source, in batches of some sizes."""
    with source as opened:
        batches = [
            {name: rows.copy() for name, rows in opened.batch(size).items()} for size in sizes
        ]
    return {name: np.concatenate([batch[name] for batch in batches]) for name in batches[0]}


def options(program, *words, **parameters):
    return {
        "program": [program, *map(str, words)],
        "parameters": {"alpha": 0.1, **parameters},
        "additional": ["alpha", "seed", "count"],
    }


def initial(seed):
    values = []
    state = int(seed)
    for _ in range(SIZE**2):
        state = (1103515245 * state + 12345) % 2**31
        values.append(state / 2**31)
    return np.array(values).reshape(SIZE, SIZE)


def advanced(u, alpha):
    grid = np.pad(u, 1)
    around = grid[:-2, 1:-1] + grid[2:, 1:-1] + grid[1:-1, :-2] + grid[1:-1, 2:]
    return u + alpha * (around - 4.0 * u)


def check_heat(rows, instances=1):
    """Check rows against NumPy, bit for bit; return the seeds of their episodes."""
    seeds = set()
    for instance in range(1, instances + 1):
        mine = {name: values[rows["env_id"] == instance] for name, values in rows.items()}
        for row, step in enumerate(mine["step"]):
            assert step == row
            assert mine["episode"][row] == row // STEPS
            assert mine["count"][row] == row % STEPS
            if row % STEPS == 0:
                u = initial(mine["seed"][row])
                seeds.add(int(mine["seed"][row]))
            np.testing.assert_array_equal(mine["u"][row], u)
            u = advanced(u, mine["alpha"][row])
            np.testing.assert_array_equal(mine["next"][row], u)
    return seeds


LANGUAGES = ["heat", "heat_fortran", "heat_python", "heat_numpy"]


@pytest.mark.parametrize("language", LANGUAGES)
def test_the_samples_of_a_program_are_those_of_numpy_bit_for_bit(local, language, request):
    program = request.getfixturevalue(language)
    rows = run(local("external/program", env_kwargs=options(program, SIZE, STEPS, 2)), 4, 10, 1)
    assert len(rows["u"]) == 15
    assert len(check_heat(rows)) == 5  # another seed in each episode
    assert rows["count"].dtype == "int32"


@pytest.mark.parametrize("episodes", [1, 2, 100])
def test_rows_do_not_depend_on_how_often_a_program_is_started(local, heat, episodes):
    def made(count):
        kwargs = options(heat, SIZE, STEPS, count)
        return run(local("external/program", env_kwargs=kwargs, num_clients=2), 14)

    rows, others = made(3), made(episodes)
    for name in rows:
        np.testing.assert_array_equal(rows[name], others[name])


@pytest.mark.parametrize("episodes", [1, 2, 100])
def test_independent_episodes_of_a_program_follow_from_their_number(local, heat, episodes):
    """It is started for each one, or asks for the next parameters."""
    by_number = {}
    for instances in (1, 2):
        given = {"num_clients": instances, "independent_episodes": True}
        kwargs = options(heat, SIZE, STEPS, episodes)
        rows = run(local("external/program", env_kwargs=kwargs, **given), 5, 13)
        assert len(check_heat(rows, instances)) == 6
        numbers = rows["episode"] * instances + rows["env_id"] - 1
        for number in range(6):
            seed, *others = rows["seed"][numbers == number].tolist()
            assert by_number.setdefault(number, seed) == seed
            assert others == [seed] * (STEPS - 1)


def test_clients_make_the_rows_that_are_made_in_process(local, clients, heat, heat_fortran):
    given = {"num_clients": 2}
    ours = run(local("external/program", env_kwargs=options(heat, SIZE, STEPS, 2), **given), 8, 20)
    for program in (heat, heat_fortran):
        kwargs = options(program, SIZE, STEPS, 2)
        theirs = run(clients("external/program", env_kwargs=kwargs, **given), 8, 20)
        assert list(ours) == list(theirs)
        for name in ours:
            assert ours[name].tobytes() == theirs[name].tobytes()
    assert len(check_heat(ours, 2)) == 10


@pytest.mark.parametrize("language", LANGUAGES)
def test_a_program_asks_for_predictions(local, clients, services, language, request):
    services.predict = lambda fields: {"next": 0.5 * np.asarray(fields["u"])}
    kwargs = options(request.getfixturevalue(language), SIZE, STEPS, 2, "ask")
    ours = run(local("external/program", env_kwargs=kwargs), 7)
    np.testing.assert_array_equal(ours["predicted"], 0.5 * ours["u"])
    check_heat(ours)
    theirs = run(clients("external/program", env_kwargs=kwargs, run_ahead=0), 7)
    np.testing.assert_array_equal(ours["predicted"], theirs["predicted"])


def sampled(program, episodes, as_clients, **ranges):
    """Return the rows and the sets of a run whose sampler chooses the parameters."""
    kwargs = {"program": [program, str(SIZE), str(STEPS), str(episodes)], "ranges": ranges}
    environment = EnvironmentConfig(
        "external/program",
        env_kwargs=kwargs,
        as_tcp_ip_client=as_clients,
        num_clients=2,
        sampler="physx/sobol",
        seed=3,
    )
    run = DataGeneration(environment, batch_nb=3, batch_size=10, quiet=True)
    run.execute()
    with Dataset.open(run.session.dataset_dir) as dataset:
        return [
            {name: dataset[mode][name][:] for name in dataset.fields(mode)}
            for mode in ("training", "parameters")
        ]


@pytest.mark.faults
def test_a_sampler_chooses_the_parameters_of_a_program(heat, heat_fortran):
    limits = {"low": 0.05, "high": 0.25, "distribution": "log_uniform"}
    rows, sets = sampled(heat, 1, False, alpha=limits)
    for program, episodes, as_clients in [(heat, 1, True), (heat_fortran, 99, True)]:
        for mine, others in zip(
            (rows, sets), sampled(program, episodes, as_clients, alpha=limits), strict=True
        ):
            assert list(mine) == list(others)
            for name in mine:
                assert mine[name].tobytes() == others[name].tobytes(), name
    place = {number: index for index, number in enumerate(sets["set"])}
    numbers = rows["episode"] * 2 + rows["env_id"] - 1
    np.testing.assert_array_equal(rows["alpha"], sets["alpha"][[place[n] for n in numbers]])
    assert len({*rows["seed"]}) == len({*numbers}) > 5
    for u, alpha, following in zip(rows["u"], rows["alpha"], rows["next"], strict=True):
        np.testing.assert_array_equal(following, advanced(u, alpha))


@pytest.mark.parametrize(
    ("ranges", "text"),
    [
        ({"alpha": 3}, r"ranges must have \[low, high\] or a table"),
        ({"alpha": [2, 1]}, "low must be below high"),
        ({"alpha": {"lowest": 1}}, 'The range of the parameter "alpha" has no option "lowest"'),
        ({"seed": [0, 1]}, "The parameters seed are given more than once"),
        ({"beta": [0, 1]}, "The parameters beta are given more than once"),
    ],
)
def test_ranges_are_checked(local, ranges, text):
    kwargs = {"program": "true", "parameters": {"beta": 1}, "ranges": ranges}
    with (
        pytest.raises(ConfigError, match=text),
        local("external/program", env_kwargs=kwargs) as source,
    ):
        source.batch(1)


def test_arrays_that_no_socket_holds_at_once_arrive_whole(local, services, heat):
    services.predict = lambda fields: {"next": 2.0 * np.asarray(fields["u"])}
    kwargs = options(heat, 400, 2, 1, "ask")
    rows = run(local("external/program", env_kwargs=kwargs), 3)
    assert rows["u"].shape == (3, 400, 400) and np.ptp(rows["u"][0]) > 0.99
    np.testing.assert_array_equal(rows["predicted"], 2.0 * rows["u"])
    np.testing.assert_array_equal(rows["u"][1], rows["next"][0])


def test_a_client_whose_program_fails_is_started_again(local, clients, heat):
    command = f"exec {heat} {SIZE} {STEPS} 1"
    rows = run(
        local("external/program", env_kwargs=options("/bin/sh", "-c", command), num_clients=2), 14
    )
    fails = "if [ -e first -a ! -e again ]; then touch again; exit 3; fi; touch first"
    script = f'if [ "$PHYSX_INSTANCE" = 2 ]; then {fails}; fi; {command}'
    kwargs = options("/bin/sh", "-c", script)
    others = run(clients("external/program", env_kwargs=kwargs, num_clients=2, retries=1), 14)
    assert Path("again").exists()
    for name in rows:
        assert rows[name].tobytes() == others[name].tobytes()


def test_fields_may_have_units(local, heat):
    kwargs = {**options(heat, 3, 2, 1), "units": {"u": "K"}}
    with local("external/program", env_kwargs=kwargs) as source:
        units = {field.name: field.unit for field in source.fields}
    assert units["u"] == "K" and units["next"] == ""


@pytest.mark.parametrize("as_clients", [False, True])
def test_a_training_learns_from_a_program_that_asks_its_network(heat, as_clients):
    environment = EnvironmentConfig(
        "external/program",
        env_kwargs=options(heat, SIZE, STEPS, 2, "ask"),
        as_tcp_ip_client=as_clients,
        num_clients=2,
        seed=3,
    )
    network = NetworkConfig(
        "toy/linear", network_kwargs={"net_fields": ["u"], "opt_fields": "next"}
    )
    training = Training(
        network,
        environment_config=environment,
        session_name="learned",
        epoch_nb=1,
        batch_nb=12,
        batch_size=6,
        seed=0,
        quiet=True,
    )
    training.execute()
    with Dataset.open(training.session.path / "dataset") as dataset:
        rows = {name: dataset["training"][name][:] for name in dataset["training"]}
    check_heat(rows, 2)
    assert not rows["predicted"][:6].any()  # by the network that has learned nothing yet
    # The linear model finds the heat equation as soon as there are more samples than numbers.
    np.testing.assert_allclose(rows["predicted"][-6:], rows["next"][-6:], atol=1e-9)


def test_the_command_line_starts_a_program(heat, capsys):
    words = f'program=["{heat}", "{SIZE}", "{STEPS}", "2"]'
    status = main(
        [
            *("generate", "external/program", "--environment.env-kwargs", words),
            *("parameters={alpha=0.1}", "additional=['seed']", "--environment.num-clients", "2"),
            *("--batch-nb", "2", "--batch-size", "9", "--environment.seed", "1"),
        ]
    )
    assert status == 0, capsys.readouterr().err
    with Dataset.open("sessions/data_generation/dataset") as dataset:
        rows = {name: dataset["training"][name][:] for name in dataset["training"]}
        roles = {field.name: field.role for field in dataset.fields("training").values()}
    assert len(rows["u"]) == 18
    assert len(check_heat(rows, 2)) == 6
    assert roles["seed"] == "additional" and roles["u"] == "training"


def test_include_prints_the_folder_of_the_header(capsys):
    assert main(["include"]) == 0
    folder = capsys.readouterr().out.strip()
    assert {"physx.h", "physx.f90", "physx_fortran.c", "physx.py"} <= {
        path.name for path in Path(folder).iterdir()
    }
    assert main(["include", "--help"]) == 0
    assert main(["include", "all"]) == 1


WIRE = [sys.executable, "-S", str(SOURCES / "wire.py")]


def test_a_program_in_any_language_can_speak_the_protocol(local):
    kwargs = {"program": WIRE, "parameters": {"scale": 10}}
    rows = run(local("external/program", env_kwargs=kwargs), 4)
    np.testing.assert_array_equal(rows["x"][:, 0], [0, 10, 20, 0])
    np.testing.assert_array_equal(rows["x"][1], [10, 11, 12])


@pytest.mark.parametrize(
    "seed", [pytest.param(n, marks=pytest.mark.faults if n > 9 else []) for n in range(60)]
)
def test_whatever_a_program_says_is_a_sample_or_a_clear_error(local, seed):
    kwargs = {"program": [*WIRE, str(seed)], "parameters": {"scale": 10}, "timeout": 30}
    try:
        rows = run(local("external/program", env_kwargs=kwargs), 3)
    except (ProgramError, SampleError) as error:
        assert str(error).partition("Last lines")[0].isprintable()
        return
    assert rows["x"].shape == (3, 3) and np.isfinite(rows["x"]).all()


OPEN = """
#include "physx.h"
int main(void)
{
    float x[6] = {1, 2, 3, 4, 5, 6};
    double z[2] = {0, 1};
    physx_run run;
    physx_array fields[] = {{"x", PHYSX_FLOAT32, PHYSX_OPEN, {0}, NULL},
                            {"z", PHYSX_COMPLEX128, 0, {0}, NULL}};
    physx_array sample[] = {{"x", PHYSX_FLOAT32, 2, {2, 3}, x}, {"z", PHYSX_COMPLEX128, 0, {0}, z}};
    if (physx_open(&run, fields, 2) || physx_send(&run, sample, 2)) return 1;
    sample[0].shape[0] = OTHER;
    if (physx_send(&run, sample, 2)) return 1;
    return physx_close(&run) ? 1 : 0;
}
"""


@pytest.fixture
def opened(build, tmp_path):
    """Return a function that compiles a program whose first field has an open shape, in C++."""

    def make(other):
        source = tmp_path / f"open{other}.cpp"
        source.write_text(OPEN.replace("OTHER", str(other)))
        flags = ("-std=c++11", "-Wall", "-Wextra", "-Werror", "-pedantic")
        return build(source, *flags, using="g++")

    return make


def test_open_shapes_are_taken_from_the_first_sample(local, opened):
    rows = run(local("external/program", env_kwargs={"program": opened(2)}), 2)
    assert rows["x"].shape == (2, 2, 3) and rows["x"].dtype == "float32"
    np.testing.assert_array_equal(rows["x"][0], [[1, 2, 3], [4, 5, 6]])
    np.testing.assert_array_equal(rows["z"], [1j, 1j])
    with (
        pytest.raises(Exception, match=r"has shape \(1, 3\) but is defined as \(2, 3\)"),
        local("external/program", env_kwargs={"program": opened(1)}) as source,
    ):
        source.batch(2)


def test_the_header_compiles_in_several_standards_and_with_several_files(build, tmp_path):
    (tmp_path / "both.h").write_text('#include "physx.h"\nint other(void);\n')
    source = tmp_path / "several.c"
    source.write_text('#include "both.h"\n#include "physx.h"\nint main(void) { return 0; }\n')
    for standard in ("c99", "c11", "c17", "gnu17"):
        build(
            source, f"-std={standard}", "-Wall", "-Wextra", "-Werror", "-pedantic", "-Wconversion"
        )
    other = tmp_path / "several.cpp"
    other.write_text(source.read_text())
    for standard in ("c++98", "c++11", "c++20"):
        flags = ("-Wall", "-Wextra", "-Werror", "-pedantic")
        build(other, f"-std={standard}", *flags, using="g++")


def test_a_program_of_several_processes_speaks_by_one(local, build, monkeypatch):
    if shutil.which("mpicc") is None and os.environ.get("CI") != "true":
        pytest.skip("no MPI is installed (openmpi-bin, libopenmpi-dev)")
    for name in ("ALLOW_RUN_AS_ROOT", "ALLOW_RUN_AS_ROOT_CONFIRM"):
        monkeypatch.setenv(f"OMPI_{name}", "1")
    program = ["mpirun", "--oversubscribe", "-n", "2", build("mean.c", "-std=c99", using="mpicc")]
    kwargs = {"program": program, "parameters": {"scale": 10.0}}
    rows = run(local("external/program", env_kwargs=kwargs), 4)
    np.testing.assert_array_equal(rows["sum"], [30.0, 32.0, 34.0, 30.0])
    np.testing.assert_array_equal(rows["episode"], [0, 0, 0, 1])


WAYS = {
    "abort": r"was killed by signal 6 \(SIGABRT\) after 2 samples, without physx_close\(\)",
    "exit": r"ended with exit status 3 after 2 samples, without physx_close\(\)",
    "leave": r"ended with exit status 0 after 2 samples, without physx_close\(\)",
    "hang": r"did nothing for 2 s",
    "hang with a child": r"did nothing for 2 s",
    "ignore": r"did nothing for 2 s",
    "never open": r"did nothing for 2 s",
    "no open": r"ended with exit status 0 before physx_open\(\)",
    "no fields": r"declared no fields in physx_open\(\)",
    "no sample": r"called physx_close\(\) without having sent a sample",
    "status": r"ended with exit status 4 after physx_close\(\)",
    "stay": r"was still running 2 s after physx_close\(\)",
    "garbage": r"sent 74 68 65 72\.\.\. where a message should start",
    "version": r"of protocol 2, but this physx uses 1: compile it",
    "kind": r"a message of kind 63 with 0 arrays",
    "huge": r"sent a message of kind 3 with 1 arrays of 9223372036854775807 bytes",
    "half": r"did nothing for 2 s",
    "type": r'gave the array "x" the unknown type 7',
    "rank": r'gave the array "x" the rank 99',
    "shape": r'gave the array "x" the shape \(-1,\)',
    "name": r"named an array 'a b\\n\\x1b\[31m', which is not an identifier",
    "reserved": r"named an array 'step', .*or is reserved by physx",
    "length": r"described arrays of 4 bytes, but announced 8",
    "twice": r"called physx_open\(\) twice",
    "no inputs": r"called physx_predict\(\) without inputs",
    "unknown parameter": r'"alpah", which does not exist. Did you mean "alpha"\?',
    "parameter type": r'parameter "alpha" as int32 of shape \(\): .*holds float64',
    "parameter shape": r'parameter "alpha" as float64 of shape \(3,\): .*has shape \(\)',
    "flag": r'sent "flag", which is neither true nor false',
    "too many": r"ended with exit status 5[^§]*physx: physx_send: it takes 0 to 64 arrays",
    "no data": r"ended with exit status 5[^§]*physx: physx_send: x: it has no data",
}


SLOW = {"hang with a child", "ignore", "half", "never open"}


def options_of(faulty, way):
    """Return the arguments of a program that breaks in one way; some are noticed after a while."""
    timeout = 2 if "2 s" in WAYS[way] else 50
    return {"program": [faulty, way], "parameters": {"alpha": 0.5}, "timeout": timeout}


@pytest.mark.parametrize(
    "way", [pytest.param(way, marks=pytest.mark.faults if way in SLOW else []) for way in WAYS]
)
def test_what_a_program_does_wrong_is_told_with_its_last_words(
    local, faulty, way, nothing_stays_behind
):
    kwargs = options_of(faulty, way)
    if way == "stay":  # it has to end although it sends no message
        kwargs["program"] = ["/bin/sh", "-c", f"{faulty} stay; exit 1"]
    with (
        pytest.raises(ProgramError, match=WAYS[way]) as caught,
        local("external/program", env_kwargs=kwargs) as source,
    ):
        source.batch(2)
        source.batch(2)
    error = caught.value
    assert str(error).startswith(f"The program {faulty}") or way == "stay"
    assert error.stderr.startswith("last words")
    assert "\x1b" not in str(error).partition("Last lines")[0]
    assert any("of instance 1" in note for note in error.__notes__)


@pytest.mark.parametrize(
    ("way", "kind", "text"),
    [
        ("missing", MissingFieldError, 'Instance 1, step 0: field "flag" is missing'),
        ("nan", NotFiniteError, 'Instance 1, step 0: field "x" holds NaN'),
    ],
)
def test_samples_of_a_program_are_checked_as_all_others(local, faulty, way, kind, text):
    with (
        pytest.raises(kind, match=text),
        local("external/program", env_kwargs={"program": [faulty, way]}) as source,
    ):
        source.batch(2)


@pytest.mark.parametrize(
    "way", ["exit", "hang", pytest.param("unknown parameter", marks=pytest.mark.faults)]
)
def test_a_client_reports_its_program(clients, faulty, way):
    kwargs = options_of(faulty, way)
    with (
        pytest.raises(ProgramError, match=WAYS[way]) as caught,
        clients("external/program", env_kwargs=kwargs, num_clients=2) as source,
    ):
        source.batch(8)
    assert caught.value.stderr.startswith("last words")
    assert caught.value.exit_status == (3 if way == "exit" else None)


def test_a_program_that_cannot_be_started_is_named(local):
    for program, text in [
        ("./nothing", r"The program ./nothing cannot be started: there is no such program"),
        (["/bin/sh", "-c", "exit 9"], r"'exit 9' ended with exit status 9 before physx_open\(\)"),
    ]:
        with (
            pytest.raises(ProgramError, match=text),
            local("external/program", env_kwargs={"program": program}) as source,
        ):
            source.batch(1)


@pytest.mark.parametrize("program", [[], "", ["a", 1], {"a": 1}, ["a\0b"]])
def test_a_program_is_a_list_of_texts(local, program):
    with (
        pytest.raises(ConfigError, match="must be a list of strings"),
        local("external/program", env_kwargs={"program": program}) as source,
    ):
        source.batch(1)


@pytest.mark.parametrize("timeout", [0, -1.0, "long"])
def test_a_timeout_is_a_number_of_seconds(local, timeout):
    kwargs = {"program": "true", "timeout": timeout}
    with (
        pytest.raises(ConfigError, match="timeout must be a number of seconds above 0"),
        local("external/program", env_kwargs=kwargs) as source,
    ):
        source.batch(1)


def test_arguments_that_do_not_fit_the_program_are_told(local, heat):
    for wrong in ({"additional": ["alfa"]}, {"units": {"alfa": "m"}}):
        with (
            pytest.raises(ConfigError, match='declares no field "alfa". Did you mean "alpha"'),
            local("external/program", env_kwargs={**options(heat, 3, 3, 1), **wrong}) as source,
        ):
            source.batch(1)
    with (
        pytest.raises(ConfigError, match="The parameters seed are given more than once"),
        local("external/program", env_kwargs=options(heat, seed=3)) as source,
    ):
        source.batch(1)


def test_a_program_that_declares_other_fields_the_next_time_is_told(local, heat):
    script = f"n=3; [ -e once ] && n=4; touch once; exec {heat} $n 2 1"
    kwargs = {"program": ["/bin/sh", "-c", script], "parameters": {"alpha": 0.1}}
    with (
        pytest.raises(ProgramError, match="declared different fields when it was started again"),
        local("external/program", env_kwargs=kwargs) as source,
    ):
        source.batch(3)


def test_a_program_that_runs_by_itself_says_so(build, heat):
    variables = {name: value for name, value in os.environ.items() if name != "PHYSX_SOCKET"}
    done = subprocess.run([heat], capture_output=True, text=True, env=variables)
    assert done.returncode == 1
    assert "this program was not started by a physx run" in done.stderr
    missing = subprocess.run(
        [heat], capture_output=True, text=True, env={**variables, "PHYSX_SOCKET": "/nowhere/s"}
    )
    assert missing.returncode == 1 and "No such file or directory" in missing.stderr
    long = subprocess.run(
        [heat], capture_output=True, text=True, env={**variables, "PHYSX_SOCKET": "/x" * 100}
    )
    assert long.returncode == 1 and "path is too long" in long.stderr


def test_a_long_folder_for_temporary_files_is_told(local, heat, tmp_path, monkeypatch):
    folder = tmp_path / ("x" * 100)
    folder.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(folder))
    with (
        pytest.raises(ProgramError, match="set TMPDIR to a folder with a shorter path"),
        local("external/program", env_kwargs=options(heat)) as source,
    ):
        source.batch(1)


@pytest.mark.parametrize(
    ("number", "as_clients"),
    [
        (signal.SIGKILL, True),
        (signal.SIGTERM, False),
        pytest.param(signal.SIGINT, True, marks=pytest.mark.faults),
        pytest.param(signal.SIGINT, False, marks=pytest.mark.faults),
        pytest.param(signal.SIGTERM, True, marks=pytest.mark.faults),
        pytest.param(signal.SIGKILL, False, marks=pytest.mark.faults),
    ],
)
def test_a_program_ends_with_the_run_that_started_it(
    faulty, number, as_clients, nothing_stays_behind
):
    place = "" if as_clients else "no-"
    script = f"touch begun$PHYSX_INSTANCE; {faulty} 'hang with a child'; sleep 600"
    words = [
        *("generate", "external/program", f"--environment.{place}as-tcp-ip-client"),
        *("--environment.env-kwargs", f"program={json.dumps(['/bin/sh', '-c', script])}"),
        *("--environment.num-clients", "2", "--batch-nb", "9", "--batch-size", "8"),
    ]
    process = subprocess.Popen([sys.executable, "-m", "physx_core", *words], stderr=subprocess.PIPE)
    with process:
        deadline = time.monotonic() + 60
        while not all(Path(f"begun{n}").exists() for n in (1, 2)) and time.monotonic() < deadline:
            time.sleep(0.02)
        process.send_signal(number)
        error = process.communicate(timeout=60)[1].decode()
    assert process.returncode == {2: 130, 15: 143, 9: -9}[number], error


@pytest.mark.parametrize("named", [[], ["external/program"]])
def test_a_dataset_cannot_name_a_program_to_run(heat, capsys, named):
    program = ["/bin/sh", "-c", f"touch ran; exec {heat} 3 2 1"]
    words = f"program={json.dumps(program)}"
    generate = ["generate", "external/program", "--environment.env-kwargs", words]
    status = main([*generate, "parameters={alpha=0.1}", "--batch-nb", "1", "--batch-size", "2"])
    assert status == 0, capsys.readouterr().err
    Path("ran").unlink()
    replay = ["replay", "sessions/data_generation", *named]
    assert main([*replay, "--session-name", "one"]) == 1
    assert "the programs that they name" in capsys.readouterr().err
    assert not Path("ran").exists()
    assert main([*replay, "--session-name", "two", "--trust"]) == 1
    assert "never reads Environment.sample" in capsys.readouterr().err
    assert Path("ran").exists()


def test_a_reservoir_and_active_sampling_learn_the_same_from_clients_as_in_process(heat):
    weights = []
    for as_clients in (False, True):
        environment = EnvironmentConfig(
            "external/program",
            env_kwargs={"program": [heat, "4", "4", "3"], "ranges": {"alpha": [0.01, 0.2]}},
            as_tcp_ip_client=as_clients,
            num_clients=2,
            episode_steps=4,
            sampler="physx/active",
            seed=3,
        )
        training = Training(
            NetworkConfig("toy/linear", network_kwargs={"net_fields": "u", "opt_fields": "next"}),
            environment_config=environment,
            epoch_nb=2,
            batch_nb=15,
            batch_size=6,
            online="physx/reservoir",
            online_kwargs={"capacity": 40, "watermark": 12, "views": 3},
            seed=0,
            quiet=True,
        )
        training.execute()
        weights.append(load_learner(training.session.path).network.weights)
    assert weights[0].any() and weights[0].tobytes() == weights[1].tobytes()
