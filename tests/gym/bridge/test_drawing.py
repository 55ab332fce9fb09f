"""A Gymnasium environment that generates a dataset is drawn; the recording is read back."""

import gymnasium
import numpy as np
import pytest

from physx_core import DataGeneration, Dataset, EnvironmentConfig

pytestmark = pytest.mark.processes

rr = pytest.importorskip("rerun")
pytest.importorskip("physx_rerun")


@pytest.fixture
def generate(tmp_path):
    """Return a function that generates some rows; it returns the session's folder."""

    def run(environment, **options):
        options = {"as_tcp_ip_client": False, "seed": 3, **options}
        config = EnvironmentConfig(environment, **options)
        generation = DataGeneration(
            config, session_dir=str(tmp_path), batch_nb=2, batch_size=30, quiet=True
        )
        generation.execute()
        return generation.session.path

    return run


def drawn(session):
    """Return the entities of a session's recording, each with its number of positions in time."""
    (recording,) = session.glob("*.rrd")
    found = {}
    for chunk in rr.chunk.RrdReader(recording).stream():
        rows = 0 if chunk.is_static else chunk.num_rows
        found[chunk.entity_path] = found.get(chunk.entity_path, 0) + rows
    return found


@pytest.mark.parametrize("clients", [0, 2])
def test_a_robot_is_drawn_at_each_step(generate, clients):
    options = {"as_tcp_ip_client": bool(clients), "num_clients": clients or 1}
    session = generate("gym/physx/Cartpole-v0", visualizer="rerun", **options)
    entities = drawn(session)
    for number in range(1, (clients or 1) + 1):
        mine = [rows for name, rows in entities.items() if name.startswith(f"/env_{number}/")]
        assert max(mine) >= 60 // (clients or 1)
    plain = generate("gym/physx/Cartpole-v0", **options)
    with Dataset.open(session) as one, Dataset.open(plain) as other:
        for name in one.fields("training"):
            np.testing.assert_array_equal(one["training"][name][:], other["training"][name][:])


def test_the_robot_moves_in_simulated_time(generate):
    session = generate("gym/physx/Cartpole-v0", visualizer="rerun")
    (recording,) = session.glob("*.rrd")
    chunks = rr.chunk.RrdReader(recording).stream()
    times = {
        time
        for chunk in chunks
        if chunk.entity_path.startswith("/env_1/") and "sim_time" in chunk.timeline_names
        for time in chunk.to_record_batch().column("sim_time").to_pylist()
    }
    assert len(times) >= 50


class Painted(gymnasium.Env):
    """Renders a picture whose brightness is its number of steps."""

    metadata = {"render_modes": ["rgb_array"]}  # noqa: RUF012
    observation_space = gymnasium.spaces.Box(-1, 1, (1,))
    action_space = gymnasium.spaces.Discrete(2)

    def __init__(self, render_mode=None):
        self.render_mode, self.count = render_mode, 0

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return np.zeros(1, np.float32), {}

    def step(self, action):
        self.count += 1
        return np.zeros(1, np.float32), 0.0, False, False, {}

    def render(self):
        return np.full((4, 6, 3), self.count, np.uint8)


def test_another_environment_shows_the_pictures_that_it_renders(generate):
    kwargs = {"id": f"{__file__}:Painted", "render_mode": "rgb_array"}
    session = generate("physx_gym:GymEnvironment", env_kwargs=kwargs, visualizer="rerun")
    assert max(rows for name, rows in drawn(session).items() if "picture" in name) >= 60


def test_a_warning_says_how_another_environment_renders_pictures(generate):
    kwargs = {"id": f"{__file__}:Painted"}
    with pytest.warns(UserWarning, match=r"cannot be drawn: .* render_mode=rgb_array"):
        generate("physx_gym:GymEnvironment", env_kwargs=kwargs, visualizer="rerun")
