"""Makes the pages in docs/reports, which docs/report.md links: one of each kind, of small runs.

python docs/reports.py    # two minutes; equal versions on one machine make equal bytes
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path

HERE = Path(__file__).resolve().parent
PAGES = {
    "generation": "sessions/cloth",
    "surrogate": "sessions/surrogate",
    "meshes": "sessions/meshes",
    "online": "sessions/online",
    "policy": "sessions/policy",
    "sweep": "studies/sweep",
}
"""Session, or study, of each page."""
CLOTH = '''
import numpy as np
from physx_core import Environment, Field, Parameter

SIDE = 12

class Cloth(Environment):
    """A cloth that hangs at two corners, in wind that a network knows."""

    episode_steps = 40
    step_time = 0.04

    def create(self):
        self.define_parameters([Parameter("gust", 0.5, 3.0, unit="N")])
        x, y = np.meshgrid(np.linspace(0, 1, SIDE), np.linspace(0, 1, SIDE))
        self.rest = np.stack([x.ravel(), 0 * x.ravel(), y.ravel()], 1)
        place = np.arange(SIDE**2).reshape(SIDE, SIDE)
        pairs = [(place[:, :-1], place[:, 1:]), (place[:-1], place[1:])]
        self.first, self.second = (np.concatenate([p[k].ravel() for p in pairs]) for k in (0, 1))
        corners = place[:-1, :-1], place[1:, :-1], place[:-1, 1:], place[1:, 1:]
        a, b, c, d = (each.ravel() for each in corners)
        self.cells = np.concatenate([np.stack([a, b, c], 1), np.stack([b, d, c], 1)])

    def init_database(self):
        self.define_training_fields([
            Field("x", (SIDE**2, 3), unit="m"),
            Field("v", (SIDE**2, 3), unit="m/s"),
            Field("wind", (1,), unit="N"),
        ])

    def init_visualization(self):
        self.factory.add_mesh("cloth", self.rest, self.cells, color="steelblue")

    def reset_parameters(self, gust):
        self.x, self.v, self.t = self.rest.copy(), np.zeros_like(self.rest), 0.0
        self.gust, self.phase = gust, self.rng.uniform(0, 6)

    def step(self):
        wind = self.gust * np.sin(3 * self.t + self.phase)
        for _ in range(20):
            force = np.tile([0.0, wind, -3.0], (SIDE**2, 1)) / SIDE**2
            d = self.x[self.second] - self.x[self.first]
            length = np.linalg.norm(d, axis=1)[:, None]
            pull = 40 * (1 - 1 / ((SIDE - 1) * length)) * d
            np.add.at(force, self.first, pull)
            np.add.at(force, self.second, -pull)
            self.v = 0.985 * (self.v + 0.002 * force * SIDE**2)
            self.v[[-SIDE, -1]] = 0
            self.x = self.x + 0.002 * self.v
        self.t += 0.04
        self.set_training_data(x=self.x, v=self.v, wind=[wind])
        self.factory.update_mesh("cloth", positions=self.x)
'''


SURROGATE = """
[training]
epoch_nb = 30
batch_size = 32
seed = 0

[training.dataset]
existing_dir = "sessions/cloth"
normalize = { x_next = "increment", v_next = "increment" }

[training.dataset.view]
window.x = { field = "x", at = 0 }
window.v = { field = "v", at = 0 }
window.wind_next = { field = "wind", at = 1 }
window.x_next = { field = "x", at = 1 }
window.v_next = { field = "v", at = 1 }

[training.network]
network = "torch/fc"
loss = "MSELoss"
optimizer = "Adam"
lr = 2e-3

[training.network.network_kwargs]
layers = [865, 128, 864]
net_fields = ["x", "v", "wind_next"]
opt_fields = ["x_next", "v_next"]
"""
MESHES = """
[training]
epoch_nb = 10
batch_size = 4
seed = 0
dataset = { existing_dir = "sessions/plate", normalize = true }

[training.network]
network = "torch/graph"
loss = "MSELoss"
optimizer = "Adam"
lr = 5e-3

[training.network.network_kwargs]
nodes = 4
outputs = 1
hidden = 32
net_fields = ["place", "edge", "before"]
opt_fields = "after"
"""
ONLINE = """
[training]
epoch_nb = 8
batch_nb = 20
batch_size = 32
seed = 0

[training.environment]
environment = "toy/spring"
num_clients = 2

[training.network]
network = "torch/fc"
network_kwargs = { layers = [3, 32, 2], net_fields = ["state", "force"], opt_fields = "next_state" }
loss = "MSELoss"
optimizer = "Adam"
lr = 1e-2
"""
SWEEP = """
[study]
seeds = [0, 1, 2]

[run]
parallel = 2

[parameters]
training.network.lr = [1e-3, 1e-2, 1e-1]
training.network.network_kwargs.layers = [[3, 2], [3, 16, 2], [3, 64, 2]]

[pipelines.spring.training]
epoch_nb = 4
batch_size = 20
dataset = { existing_dir = "sessions/springs", view = { fold = 0 }, normalize = true }

[pipelines.spring.training.network]
network = "torch/fc"
network_kwargs = { net_fields = ["state", "force"], opt_fields = "next_state" }
loss = "MSELoss"
optimizer = "Adam"
"""
LEARN = """
import gymnasium
from stable_baselines3 import PPO

from physx_gym.stable_baselines3 import GymnasiumVecEnv, save_policy

if __name__ == "__main__":
    many = gymnasium.make_vec("physx/Cartpole-v0", 8, num_processes=1, autoreset_mode="SameStep")
    model = PPO("MlpPolicy", GymnasiumVecEnv(many), n_steps=128, batch_size=256, seed=0)
    model.learn(20_000)
    save_policy(model, "sessions/policy")
    many.close()
"""
COMMANDS = """
physx generate cloth.py:Cloth --episodes 40 --environment.seed 1 --session-name cloth --quiet
physx train --config surrogate.toml --session-name surrogate --quiet
physx evaluate sessions/surrogate

physx generate plate.py:Plate --episodes 200 --environment.seed 1 --session-name plate --quiet
physx train --config meshes.toml --session-name meshes --quiet

physx generate toy/spring --mode validation --batch-nb 10 --batch-size 40 --environment.seed 2 \\
      --session-name online --quiet
physx train --config online.toml --session-name online --no-new-session --quiet

python learn.py
physx evaluate sessions/policy --env physx/Cartpole-v0 --env-kwargs simulation_duration_max=2.0 \\
      --film sessions/policy/film.webp
physx evaluate sessions/policy --env physx/Cartpole-v0 --env-kwargs simulation_duration_max=2.0 \\
      --backend pinocchio

physx generate toy/spring --batch-nb 20 --batch-size 25 --environment.seed 1 \\
      --session-name springs --quiet
physx sweep sweep.toml
"""
FILES = {
    "cloth.py": CLOTH,
    "surrogate.toml": SURROGATE,
    "plate.py": (HERE.parent / "examples/environments/plate.py").read_text(encoding="utf-8"),
    "meshes.toml": MESHES,
    "online.toml": ONLINE,
    "learn.py": LEARN,
    "sweep.toml": SWEEP,
}


def make(folder: Path) -> None:
    """Run in a folder what the pages are about, and write them."""
    for name, content in FILES.items():
        (folder / name).write_text(content.lstrip(), encoding="utf-8")
    script = f'set -e\nPATH="{Path(sys.executable).parent}:$PATH"\n{COMMANDS}'
    subprocess.run(["/bin/bash", "-c", script], cwd=folder, check=True)
    (HERE / "reports").mkdir(exist_ok=True)
    for name, session in PAGES.items():
        page = HERE / "reports" / f"{name}.html"
        words = [sys.executable, "-m", "physx_core.cli", "report", session, "--trust"]
        subprocess.run([*words, "--output", str(page)], cwd=folder, check=True)
        print(f"{page}: {page.stat().st_size / 1e3:.0f} kB")


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as place:
        make(Path(place))
