"""Environments: the cost of a step on top of the physics, and a comparison with gym_jiminy's.

    python benchmarks/gym.py
    python benchmarks/gym.py --jiminy PYTHON    # an interpreter that has gym_jiminy
    python benchmarks/gym.py --busy 8           # vector environments beside 8 busy processes

Without `--jiminy`, gym_jiminy is taken from the virtual environment .venv/jiminy, if there is one.
It needs an older NumPy than physx:

    python3.11 -m venv .venv/jiminy
    .venv/jiminy/bin/pip install -r benchmarks/requirements-jiminy.txt

The bare loop is what a user of the engine would write: it sets torques, calls `step(n)`, and reads
positions and velocities into existing arrays, with the same torques from the same state, so the
physics is the same. Its costs and those of `step` are the minimum of several runs for each step of
an episode, so other load on the machine does not count. The unit is one step of Gymnasium's own
CartPole-v1, run after each step of the bare loop: physics empties the processor's caches, so any
Python code after it takes up to three times as long as in its own loop. The time in its own loop is
printed, too.
"""

from __future__ import annotations

import argparse
import functools
import gc
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from jiminy_zoo import ACTIONS, steps_per_second
from measure import claim, finish, rates
from raw_vector import RawVectorEnv

import physx_gym  # noqa: F401 - registers the environments
from physx_gym import build_pipeline, load_pipeline
from physx_gym.environments.quadruped import STAND

clock = time.perf_counter
HERE = Path(__file__).parent
JIMINY = HERE.parent / ".venv" / "jiminy" / "bin" / "python"
PIPELINE = HERE.parent / "examples" / "environments" / "quadruped.toml"
ROUNDS, REPEATS = 5, 12
BUSY_ROUNDS = 9
SLICE = 0.4


def registered(name: str, **options: Any) -> Any:
    """Return an environment of physx without Gymnasium's wrappers."""
    return gymnasium.make(f"physx/{name}-v0", disable_env_checker=True, **options).unwrapped


def three_blocks() -> Any:
    """Return a quadruped with PD controller, Mahony filter and safety limit, each once per step."""
    kwargs = {"urdf": "a1/a1", "fixed_base": False, "period": 2.5e-3}
    simulator = {"cls": "physx_gym:Simulator.build", "kwargs": kwargs}
    pd = {"kp": 80.0, "kd": 0.02, "joint_velocity_limit": 12.0, "joint_acceleration_limit": 400.0}
    layers = [
        {"block": {"cls": "MotorSafetyLimit", "kwargs": {"kp": 20.0, "kd": 2.0}}},
        {"block": {"cls": "PDController", "kwargs": pd}},
        {"block": {"cls": "MahonyFilter"}},
    ]
    options = {"simulator": simulator, "step_dt": 0.02}
    return build_pipeline({"cls": "RobotEnv", "kwargs": options}, layers)()


# Cost of a step on top of the physics -----------------------------------------------------------


class Overhead:
    """Times an environment's steps, and a bare loop that makes the same calls to the engine."""

    def __init__(self, env: Any, steps: int, action: Any) -> None:
        """Record what the motors do in an episode of some steps with an action."""
        self._env, self._base, self._steps, self._action = env, env.unwrapped, steps, action
        env.reset(seed=0)
        simulator = self._base.simulator
        self._cartpole = CartPole()
        self._ticks: list[tuple[np.ndarray, int]] = []
        apply, step = simulator.apply_command, simulator.step
        command: list[np.ndarray] = []

        def noting_command() -> None:
            apply()
            command[:] = [simulator.simulation.commands()]

        def noting_step(n: int) -> None:
            self._ticks.append((command[0], n))
            step(n)

        simulator.apply_command, simulator.step = noting_command, noting_step
        for _ in range(steps):
            env.step(action)
        del simulator.apply_command, simulator.step
        self.per_step = len(self._ticks) // steps

    def whole(self) -> np.ndarray:
        """Return the times of the environment's steps, in s."""
        env, action, times = self._env, self._action, np.empty(self._steps)
        env.reset(seed=0)
        for number in range(self._steps):
            begin = clock()
            env.step(action)
            times[number] = clock() - begin
        self._end = self._base.robot_state.q.copy()
        return times

    def bare(self) -> np.ndarray:
        """Return times of the bare loop's steps, and of a step of CartPole-v1 after each, in s."""
        self._env.reset(seed=0)
        simulation, times = self._base.simulator.simulation, np.empty((2, self._steps))
        q, v = simulation.positions(), simulation.velocities()
        for number in range(self._steps):
            ticks = self._ticks[number * self.per_step : (number + 1) * self.per_step]
            begin = clock()
            for torques, n in ticks:
                simulation.set_torques(torques)
                simulation.step(n)
                simulation.positions(q)
                simulation.velocities(v)
            times[0, number] = clock() - begin
            times[1, number] = self._cartpole.time()
        if not np.array_equal(q[self._base.robot.positions], self._end):
            raise RuntimeError("The bare loop does not do what the environment does.")
        return times


class CartPole:
    """Gymnasium's own CartPole-v1."""

    def __init__(self) -> None:
        self._env, self._steps = gymnasium.make("CartPole-v1").unwrapped, 0

    def time(self) -> float:
        """Return the time of a step, in s."""
        if self._steps % 8 == 0:  # the pole has not fallen yet
            self._env.reset(seed=0)
        self._steps += 1
        begin = clock()
        self._env.step(self._steps % 2)
        return clock() - begin


def overheads() -> list[bool]:
    """Compare steps of environments with the bare loop."""
    stand = np.tile(list(STAND.values()), 4)
    blocks = "quadruped, PD + Mahony + safety"
    cases = {
        "cartpole": (Overhead(registered("Cartpole"), 30, 1), 2.0),
        "ant": (Overhead(registered("Ant"), 8, np.zeros(8, np.float32)), 3.0),
        blocks: (Overhead(three_blocks(), 8, np.zeros(12)), 7.0),
        "with a target adapter, all 4 times a step": (
            Overhead(load_pipeline(PIPELINE)(), 6, stand),
            None,
        ),
    }
    found: dict[str, list[tuple[float, ...]]] = {name: [] for name in cases}
    alone = CartPole()
    for _ in range(ROUNDS):
        for name, (case, _) in cases.items():
            pairs = [(case.whole(), *case.bare()) for _ in range(REPEATS)]
            whole, bare, unit = np.min(pairs, axis=0)
            extra, middle = float(np.median(whole - bare)), float(np.median(unit))
            hot = min(alone.time() for _ in range(200))
            found[name].append((extra / middle, 1e6 * extra, 1e6 * bare.mean(), 1e6 * middle, hot))
    met = []
    print("A step beside the bare loop of the same robot, in steps of Gymnasium's CartPole-v1")
    for name, (case, target) in cases.items():
        units, extra, bare, unit, hot = map(statistics.median, zip(*found[name], strict=True))
        print(f"  {name}: {extra:.1f} us beside {bare:.0f} us in {case.per_step} parts", end="; ")
        print(f"the unit {unit:.1f} us ({1e6 * hot:.1f} us in a loop of its own)")
        if target is None:
            print(f"  {name}: {units:.4g}\n")
        else:
            met.append(claim(name, units, at_most=target))
    return met


# Against gym_jiminy -------------------------------------------------------------------------------


class Zoo:
    """gym_jiminy's environments in a process with another interpreter."""

    def __init__(self, python: str) -> None:
        command = [python, "-P", str(HERE / "jiminy_zoo.py")]
        pipe = subprocess.PIPE
        self._process = subprocess.Popen(command, stdin=pipe, stdout=pipe, text=True)

    def measure(self, name: str, seconds: float) -> dict[str, float]:
        """Return steps per second of an environment, and its periods."""
        stdin, stdout = self._process.stdin, self._process.stdout
        if stdin is None or stdout is None:
            raise RuntimeError("gym_jiminy's process has no pipes")
        print(name, seconds, file=stdin, flush=True)
        answer = stdout.readline()
        if not answer:
            raise RuntimeError(f"gym_jiminy's process ended; is {self._process.args} right?")
        found: dict[str, float] = json.loads(answer)
        return found

    def close(self) -> None:
        """End the process."""
        self._process.communicate()


def engine_alone(env: Any, actions: list[Any]) -> float:
    """Return the steps per second if only dartpy's ``World.step`` took time."""
    simulation, steps, spent = env.simulator.simulation, 1000, 0.0
    step = simulation._step_world

    def timed(*arguments: Any) -> None:
        nonlocal spent
        begin = clock()
        step(*arguments)
        spent += clock() - begin

    env.reset(seed=0)
    simulation._step_world = timed
    for number in range(steps):
        if any(env.step(actions[number % len(actions)])[2:4]):
            env.reset()
    simulation._step_world = step
    return steps / spent


def against_jiminy(python: str) -> list[bool]:
    """Compare steps per second with gym_jiminy, at physx's own physics period and at gym_jiminy's.

    The rate of DART's steps alone, with the same solver and detector, is printed, too: no
    environment on top of that engine can be faster.
    """
    zoo, met = Zoo(python), []
    for name, target in (("Cartpole", 1.6), ("Acrobot", 5.0), ("Ant", 1.3)):
        theirs = zoo.measure(name.lower(), 0.1)
        envs = [registered(name), registered(name)]
        envs[1].simulator.set_options({"world": {"period": theirs["period"]}})
        if abs(envs[0].simulator.period - theirs["period"]) < 1e-12:
            envs.pop()
        if abs(envs[0].step_dt - theirs["step_dt"]) > 1e-12:
            raise RuntimeError(f"{name}: step_dt is {envs[0].step_dt}, not {theirs['step_dt']}")
        envs[0].action_space.seed(0)
        actions = [envs[0].action_space.sample() for _ in range(ACTIONS)]
        for env in envs:
            env.reset(seed=0)
        rounds = []
        for _ in range(2 * ROUNDS + 1):
            row = [steps_per_second(env, actions, 0.25) for env in envs]
            alone = [(engine_alone(env, actions),) * 2 for env in envs]
            found = zoo.measure(name.lower(), 0.25)
            rounds.append([*row, *alone, (found["rate"], found["rate_of_step"])])
        # Axes: rounds, candidates, with and without resets.
        measured = np.array(rounds)
        middle = np.median(measured, axis=0)
        ratios = np.median(measured[:, :-1] / measured[:, -1:], axis=0)
        print(f"{name}, steps of {envs[0].step_dt:g} s under random actions, resets included")
        print(f"  gym_jiminy, integrating every {1e3 * theirs['period']:g} ms", end=": ")
        print(f"{middle[-1, 0]:,.0f} steps/s, {middle[-1, 1]:,.0f} without the resets")
        for env, rate, alone, ratio, bound in zip(
            envs, middle, middle[len(envs) :], ratios, ratios[len(envs) :], strict=False
        ):
            print(f"  physx, every {1e3 * env.simulator.period:g} ms", end=": ")
            print(f"{rate[0]:,.0f} steps/s, {rate[1]:,.0f} without the resets", end=", ")
            print(f"which is {ratio[1]:.2f} times as many;", end=" ")
            print(f"DART's steps alone {alone[0]:,.0f}, {bound[0]:.2f} times as many")
            met.append(claim("ratio", float(ratio[0]), at_least=target))
    zoo.close()
    return met


# Telemetry, start-up, memory ----------------------------------------------------------------------


def telemetry() -> list[bool]:
    """Compare steps in evaluation, where everything is recorded, with those in training."""
    met = []
    cases = {
        "cartpole": (registered("Cartpole"), 1, 30),
        "ant": (registered("Ant"), np.zeros(8, np.float32), 20),
        "quadruped with three blocks": (three_blocks(), np.zeros(12), 20),
    }
    for name, (env, action, steps) in cases.items():
        found = []
        for _ in range(ROUNDS):
            least = {True: np.full(steps, np.inf), False: np.full(steps, np.inf)}
            for _ in range(REPEATS):
                for training, times in least.items():
                    env.stop()
                    env.unwrapped.train(training)
                    env.reset(seed=0)
                    for number in range(steps):
                        begin = clock()
                        env.step(action)
                        times[number] = min(times[number], clock() - begin)
            found.append(least[False].sum() / least[True].sum())
        env.stop()
        env.unwrapped.train()
        met.append(
            claim(f"evaluation against training, {name}", statistics.median(found), at_most=1.2)
        )
        env.close()
    return met


_IMPORTS = "import gymnasium, dartpy"
_FIRST_RESET = """
import gymnasium, physx_gym
gymnasium.make("physx/Cartpole-v0").reset(seed=0)
"""


def start_up() -> bool:
    """Compare import and first reset with importing only the libraries underneath."""
    times: dict[str, list[float]] = {_IMPORTS: [], _FIRST_RESET: []}
    with tempfile.TemporaryDirectory() as folder:
        plain = {k: v for k, v in os.environ.items() if k != "PYTHONDONTWRITEBYTECODE"}
        environment = {**plain, "PYTHONPYCACHEPREFIX": folder}  # bytecode is compiled once
        for number in range(2 * ROUNDS + 2):
            for program, spent in times.items():
                process = subprocess.Popen([sys.executable, "-c", program], env=environment)
                _, status, usage = os.wait4(process.pid, 0)
                if status:
                    raise RuntimeError(f"{program} failed")
                if number:
                    spent.append(usage.ru_utime + usage.ru_stime)
    imports, reset = (1e3 * statistics.median(spent) for spent in times.values())
    print(
        f"New processes, time of the processor: import of gymnasium and dartpy {imports:.0f} ms; "
        f"import of physx_gym and first reset of cartpole {reset:.0f} ms"
    )
    pairs = zip(*times.values(), strict=True)
    return claim("times as long", statistics.median(b / a for a, b in pairs), at_most=1.5)


_MEMORY = """
import gc, os, sys
import dartpy, gymnasium
import physx_gym

def made():
    if sys.argv[1] == "bullet":
        return None
    if sys.argv[1].endswith(".toml"):
        return physx_gym.load_pipeline(sys.argv[1])()
    return gymnasium.make(sys.argv[1])

def resident():
    gc.collect()
    with open("/proc/self/statm") as file:
        return int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 2**20

kept, bullet = [], dartpy.collision.BulletCollisionDetector()
for number in range(50):
    env = made()
    if env is None:
        env = bullet.createCollisionGroup()
    else:
        env.reset(seed=number)
        for _ in range(5):
            env.step(env.action_space.sample())
    kept.append(env)
    if number == 9:
        before = resident()
print((resident() - before) / 40)
"""


def memory() -> list[bool]:
    """Measure the memory of each additional environment, and of Bullet's part of it alone."""
    met = []
    for name, path, most in (
        ("cartpole", "physx/Cartpole-v0", 2.0),
        ("quadruped with blocks", str(PIPELINE), 5.0),
        ("collision group of Bullet, which each world with contacts has", "bullet", None),
    ):
        command = [sys.executable, "-c", _MEMORY, path]
        done = subprocess.run(command, check=True, capture_output=True, text=True)
        found = f"MiB for each further {name}", float(done.stdout)
        if most is None:
            print(f"  {found[0]}: {found[1]:.2f}")
        else:
            met.append(claim(*found, at_most=most))
    return met


# Vector environments ------------------------------------------------------------------------------


def vectors() -> list[bool]:
    """Compare two processes of ants with one, and cartpoles with Gymnasium's vector environments.

    All run alternately in short slices, because other load on the machine varies. A vector
    environment over bare shared memory, which only does what a step needs, shows how far two
    processes that wait for each other in each step can get on this machine.
    """
    name, count = "physx/Ant-v0", 8
    ants: dict[str, Any] = {}
    for number in (1, 2):
        ants[f"bare, {number}"] = RawVectorEnv(name, count, number)
        ants[f"physx, {number}"] = gymnasium.make_vec(name, count, num_processes=number)
    ants["halves"] = gymnasium.make_vec(name, count, num_processes=2, batch_size=count // 2)
    measured = compare(ants)
    print(f"{count} ants in a vector environment, by number of processes, steps/s:")
    one = measured["physx, 1"]
    for kind in ("bare", "physx"):
        first, second = (measured[f"{kind}, {number}"] for number in (1, 2))
        print(f"  {kind}: {np.median(first):,.0f}, {np.median(second):,.0f}", end="; ")
        print(f"2 processes against 1: {np.median(second / first):.2f}")
    halves = measured["halves"]
    print(f"  physx, 2 with send and recv, batch_size={count // 2}: {np.median(halves):,.0f}")
    met = [
        claim("2 processes against 1", float(np.median(measured["physx, 2"] / one)), at_least=1.75),
        claim("with send and recv", float(np.median(halves / one)), at_least=1.9),
    ]
    name, count = "physx/Cartpole-v0", 64
    measured = compare(
        {
            "AsyncVectorEnv": gymnasium.make_vec(name, count, vectorization_mode="async"),
            "SyncVectorEnv": gymnasium.make_vec(name, count, vectorization_mode="sync"),
            "physx": gymnasium.make_vec(name, count, num_processes=2),
        }
    )
    print(f"{count} cartpoles in a vector environment, steps/s:")
    for kind, rate in measured.items():
        print(f"  {kind}: {np.median(rate):,.0f}")
    for kind, target in (("AsyncVectorEnv", 5.0), ("SyncVectorEnv", 1.5)):
        ratio = float(np.median(measured["physx"] / measured[kind]))
        met.append(claim(f"physx against {kind}", ratio, at_least=target))
    return met


def busy_vectors(load: int) -> list[bool]:
    """Compare cartpoles with Gymnasium's vector environments while other processes want the cores.

    Each candidate is a process, as in a training, and all run alternately; the load of the machine
    by others counts as well.

    Args:
        load: Number of processes that only use the processor, besides those of others.
    """
    others = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(load)]
    met = []
    try:
        for count in (1, 8, 64):
            kinds = ("physx", "async", "sync")
            served = {kind: _Served(kind, count) for kind in kinds}
            measured = {kind: np.empty(BUSY_ROUNDS) for kind in kinds}
            for number in range(BUSY_ROUNDS):
                for kind in kinds:
                    measured[kind][number] = served[kind].rate()
            for each in served.values():
                each.close()
            print(
                f"{count} cartpoles, {load} busy processes, load {os.getloadavg()[0]:.1f}, steps/s:"
            )
            for kind, found in measured.items():
                print(f"  {kind}: {np.median(found):,.0f}")
            ratio = np.median(measured["physx"] / np.maximum(measured["async"], measured["sync"]))
            met.append(claim("physx against the better of Gymnasium's", ratio, at_least=1.0))
    finally:
        for each in others:
            each.kill()
            each.wait()
    return met


_SERVED = """
import sys
import gym as benchmark
import gymnasium
kind, count = sys.argv[1], int(sys.argv[2])
options = {"num_processes": 2} if kind == "physx" else {"vectorization_mode": kind}
env = gymnasium.make_vec("physx/Cartpole-v0", count, **options)
actions = benchmark.draw(env)
env.reset(seed=0)
for _ in iter(sys.stdin.readline, ""):
    begin = benchmark.clock()
    done = benchmark.turn(env, actions)
    print(done / (benchmark.clock() - begin), flush=True)
env.close()
"""


class _Served:
    """A vector environment in a process of its own."""

    def __init__(self, kind: str, count: int) -> None:
        self._process = subprocess.Popen(
            [sys.executable, "-W", "ignore", "-c", _SERVED, kind, str(count)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            cwd=HERE,
        )
        self.rate()

    def rate(self) -> float:
        """Return the steps per second of one slice."""
        print(file=self._process.stdin, flush=True)
        return float(self._process.stdout.readline())

    def close(self) -> None:
        self._process.communicate()


def compare(candidates: dict[str, Any]) -> dict[str, np.ndarray]:
    """Return steps per second of vector environments in each round, and close them."""
    turns = {name: functools.partial(turn, env, draw(env)) for name, env in candidates.items()}
    for name, env in candidates.items():
        if not isinstance(env, RawVectorEnv):
            env.reset(seed=0)
        turns[name]()
    measured = {name: np.array(found) for name, found in rates(turns, 3 * ROUNDS).items()}
    for env in candidates.values():
        env.close()
    return measured


def draw(env: Any) -> list[np.ndarray]:
    """Return actions for some steps of a vector environment."""
    env.action_space.seed(0)
    return [env.action_space.sample() for _ in range(ACTIONS)]


def turn(env: Any, actions: list[np.ndarray]) -> int:
    """Step a vector environment for one slice; return how many steps its environments made."""
    done, begin = 0, clock()
    if getattr(env, "batch_size", None) in (None, getattr(env, "num_envs", None)):
        while clock() - begin < SLICE:
            env.step(actions[done % ACTIONS])
            done += 1
        return done * len(actions[0])
    env.send(actions[0])
    while clock() - begin < SLICE:
        ids = env.recv()[4]["env_id"]
        env.send(actions[done % ACTIONS][ids], ids)
        done += 1
    while env.num_pending:
        env.recv()
    return done * env.batch_size + len(actions[0])


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--check", action="store_true", help="exit with 1 if a target is missed")
    found = str(JIMINY) if JIMINY.exists() else None
    parser.add_argument("--jiminy", metavar="PYTHON", default=found, help="has gym_jiminy")
    parser.add_argument("--busy", metavar="N", type=int, help="only vectors, beside N processes")
    chosen = parser.parse_args()
    gc.disable()
    if chosen.busy is not None:
        finish(busy_vectors(chosen.busy))
        return
    met = overheads()
    if chosen.jiminy:
        met += against_jiminy(chosen.jiminy)
    met += [*telemetry(), start_up(), *memory(), *vectors()]
    finish(met)


if __name__ == "__main__":
    main()
