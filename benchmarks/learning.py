"""Reinforcement learning: what PPO achieves in the registered environments, over several seeds.

    python benchmarks/learning.py                                   # all of them: hours
    python benchmarks/learning.py --env physx/Ant-v0 --seeds 0 1 2
    python benchmarks/learning.py --env physx/Quadruped-v0 --check --film quadruped.webp
    python benchmarks/learning.py --env physx/Ant-v0 --folder policies --steps 300000

Trains with `examples/12_reinforcement_learning.py` once per seed, `--jobs` at a time, with the
settings in `examples/ppo.toml`; then runs deterministic episodes on the engine used for training
and on the other one. Prints a line per seed and engine, with the wall time of the training, and the
range over the seeds. With `--check`, exits with 1 if any seed misses the target on the engine used
for training. `--film FILE` shows the first seconds of episodes with the policy of the first seed.
Other options are passed on to the example. Needs stable-baselines3.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

import torch
from measure import claim, finish

from physx_gym import Policy, RobotEnv, write_film
from physx_gym.bridge.make_env import make_env
from physx_gym.cli.evaluate import evaluate, summary
from physx_sim.errors import FeatureNotSupportedError

TRAIN = Path(__file__).parent.parent / "examples" / "12_reinforcement_learning.py"
TARGETS = {
    "physx/Cartpole-v0": ("reward", 475.0, 20),
    "physx/Acrobot-v0": ("reward", -100.0, 20),
    "physx/Ant-v0": ("speed", 0.5, 5),
    "physx/Quadruped-v0": ("speed", 0.5, 5),
    "physx/PushBox-v0": ("success", 0.9, 20),
}
"""Figure of `evaluate`, the value that its mean must reach for every seed, number of episodes."""
FIRST_SEED = 30_000
FILM_TIME, FILM_SIZE, FRAME_RATE = 6.0, (320, 240), 15.0
NAMES = ("reward", "length", "speed", "success")


def train(env: str, backend: str, more: list[str], place: Path, seed: int) -> tuple[Path, float]:
    """Train a policy, and return its folder and the wall time in s."""
    name = env.removeprefix("physx/").removesuffix("-v0")
    folder = place / f"{name}_{seed}"
    words = ["--env", name, "--backend", backend, "--seeds", str(seed), "--session-dir", str(place)]
    begin = time.perf_counter()
    command = [sys.executable, str(TRAIN), *words, *more]
    done = subprocess.run(command, stdout=sys.stderr, check=False)  # 1: it lost to a rival
    if not (folder / "network").is_dir():
        sys.exit(f"The training with seed {seed} failed with status {done.returncode}.")
    return folder, time.perf_counter() - begin


def figures(env: str, backend: str, folder: Path) -> dict[str, dict[str, float]] | None:
    """Return the figures of deterministic episodes; None if the engine cannot run them."""
    made = make_env(env, {"backend": backend})
    try:
        seeds = range(FIRST_SEED, FIRST_SEED + TARGETS[env][2])
        return summary(evaluate(made, Policy(folder, made).act, seeds))
    except FeatureNotSupportedError:
        return None
    finally:
        made.close()


def film(env: str, backend: str, folder: Path, path: Path) -> None:
    """Write a small film of the first seconds of episodes."""
    made = make_env(env, {"backend": backend, "render_mode": "rgb_array"})
    base = made.unwrapped
    assert isinstance(base, RobotEnv)
    base.viewer_kwargs = {"picture_size": FILM_SIZE}
    act, every = Policy(folder, made).act, max(1, round(1 / (FRAME_RATE * base.step_dt)))

    def pictures() -> Iterator[Any]:
        seed, over, observation = FIRST_SEED, True, None
        for step in range(round(FILM_TIME / base.step_dt)):
            if over:
                observation, _ = made.reset(seed=seed)
                seed += 1
            observation, _, terminated, truncated, _ = made.step(act(observation))
            over = terminated or truncated
            if over or step % every == 0:
                yield made.render()

    try:
        print(f"film: {write_film(pictures(), path, 1 / (every * base.step_dt))}")
    finally:
        made.close()


def row(label: str, found: dict[str, dict[str, float]], seconds: str) -> None:
    """Print mean and standard deviation of each figure of a policy's episodes."""
    texts = []
    for name in NAMES:
        known = found.get(name)
        texts.append("" if known is None else f"{known['mean']:.4g} ± {known['std']:.2g}")
    print(f"{label:20}{seconds:>10}" + "".join(f"{text:>18}" for text in texts), flush=True)


def measure(env: str, chosen: argparse.Namespace, words: list[str], place: Path) -> bool:
    """Train and evaluate the policies of an environment; return whether its target is met."""
    other = {"dart": "pinocchio", "pinocchio": "dart"}[chosen.backend]
    results: dict[str, list[dict[str, Any]]] = {chosen.backend: [], other: []}
    lines = []
    run = partial(train, env, chosen.backend, words, place)
    with ThreadPoolExecutor(chosen.jobs) as pool:
        policies = list(pool.map(run, chosen.seeds))
    for seed, (folder, seconds) in zip(chosen.seeds, policies, strict=True):
        for engine, kept in results.items():
            found = figures(env, engine, folder)
            if found is not None:
                kept.append(found)
                time_of = f"{seconds:.0f}" if engine == chosen.backend else ""
                lines.append((f"{seed} on {engine}", found, time_of))
    if chosen.film:
        film(env, chosen.backend, policies[0][0], chosen.film)
    print(f"\n{env}, PPO on {chosen.backend}: mean ± standard deviation of the episodes")
    print(f"{'seed':20}{'time (s)':>10}" + "".join(f"{name:>18}" for name in NAMES))
    for line in lines:
        row(*line)
    name, target, _ = TARGETS[env]
    for engine, kept in results.items():
        values = [found[name]["mean"] for found in kept]
        if values:
            print(f"{engine}: {name} {min(values):.4g} to {max(values):.4g} over the seeds")
    least = min(found[name]["mean"] for found in results[chosen.backend])
    return claim(f"least {name} of the seeds", least, at_least=target)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--env", nargs="+", default=list(TARGETS), choices=TARGETS)
    parser.add_argument("--backend", default="dart", choices=("dart", "pinocchio"))
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--folder", type=Path, help="where to keep the policies")
    parser.add_argument("--jobs", type=int, default=1, help="trainings at a time")
    parser.add_argument("--film", type=Path, metavar="FILE", help=".webp or .gif to write")
    parser.add_argument("--check", action="store_true")
    chosen, words = parser.parse_known_args()
    if chosen.film and len(chosen.env) > 1:
        parser.error("--film shows one environment: name it with --env")
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as temporary:
        place = chosen.folder or Path(temporary)
        finish([measure(env, chosen, words, place) for env in chosen.env])


if __name__ == "__main__":
    main()
