"""Every example runs, and says what it is to show."""

import importlib.util
import re
import sys

import gymnasium
import numpy as np
import pytest

from physx_core import DataGeneration, EnvironmentConfig
from physx_core.errors import WrongSamplesError
from physx_gym import Policy
from physx_gym.cli import evaluate

pytestmark = pytest.mark.slow

pytest.importorskip("torch")


def load(path):
    """Return a script as a module."""
    spec = importlib.util.spec_from_file_location(f"examples_{path.stem}", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def number(text, pattern):
    return float(re.search(pattern, text)[1])


# The beam -------------------------------------------------------------------------------------


@pytest.fixture
def beam(root):
    """The module of the beam."""
    pytest.importorskip("felupe", reason="needs felupe, which solves the beam")
    module = load(root / "examples/beam/beam.py")
    sys.modules[module.__name__] = module
    yield module
    del sys.modules[module.__name__]


def tip_load(beam, force):
    forces = np.zeros((*beam.NODES, 3))
    forces[-1, :, :, 2] = force / 16
    return forces


def test_the_beam_bends_as_beam_theory_says_under_small_loads(beam):
    solver = beam.ElasticBeam()
    assert np.allclose(solver.rest[3, 1, 2], [3 / 15, 0.25 / 3, 0.5 / 3])
    solver.solve(tip_load(beam, 0.1))
    length, _, height = beam.SIZE
    area, inertia = height**2, height**4 / 12
    shear = beam.YOUNG / (2 * (1 + beam.POISSON)) * area * 5 / 6
    theory = 0.1 * (length**3 / (3 * beam.YOUNG * inertia) + length / shear)  # Timoshenko
    assert solver.displacement[-1, :, :, 2].mean() == pytest.approx(theory, rel=0.15)
    assert np.all(solver.displacement[0] == 0)


def test_large_loads_bend_it_less_than_in_proportion(beam):
    solver = beam.ElasticBeam()
    deflections = []
    for force in (1, 40):
        solver.solve(tip_load(beam, force))
        deflections.append(solver.displacement[-1, :, :, 2].mean())
    assert 0.3 < deflections[1] < 0.9 * 40 * deflections[0]
    solver.solve(0 * tip_load(beam, 0))  # elastic: it comes back
    assert np.abs(solver.displacement).max() < 1e-6


def test_loads_that_newton_cannot_reach_at_once_are_reached_in_steps(beam):
    whole, parts = beam.ElasticBeam(), beam.ElasticBeam()
    far = tip_load(beam, -300)
    whole.solve(far)
    for part in np.linspace(0.1, 1, 10):
        parts.solve(part * far)
    assert np.allclose(whole.displacement, parts.displacement, atol=1e-6)


def test_the_skin_is_closed_and_faces_outwards(beam):
    corners = beam.ElasticBeam().rest.reshape(-1, 3)[beam.skin()]
    volumes = np.einsum("ij,ij->i", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6
    assert volumes.sum() == pytest.approx(np.prod(beam.SIZE))


def test_a_step_that_diverges_is_refused(beam, tmp_path, monkeypatch):
    def fail(solver, forces):
        raise beam.NoEquilibriumError

    monkeypatch.setattr(beam.ElasticBeam, "solve", fail)
    config = EnvironmentConfig(beam.Beam, as_tcp_ip_client=False, max_wrong_samples_per_step=3)
    with pytest.raises(WrongSamplesError, match="rejected 4 samples"):
        DataGeneration(config, session_dir=str(tmp_path), batch_nb=1, batch_size=1).execute()


def test_the_beam_is_learned_and_compared(root, run, tmp_path):
    pytest.importorskip("felupe", reason="needs felupe, which solves the beam")
    pytest.importorskip("rerun", reason="needs physx-rerun for the recording")
    text = run(root / "examples/beam/run.py", "--small").stdout
    assert re.search(r"FC +[\d.]+% +[\d.]+%", text) and re.search(r"UNet +[\d.]+%", text)
    assert (tmp_path / "sessions/beam/fc.rrd").stat().st_size > 10_000
    assert (tmp_path / "sessions/beam/unet.rrd").stat().st_size > 10_000


# Operators ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("problem", "library", "network"),
    [
        ("ring", "neuralop", "Fourier neural operator"),
        ("plate", "torch_geometric", "graph network"),
        ("picture", "torch", "UNet"),
    ],
)
def test_operators_are_learned_by_networks_of_other_libraries(problem, library, network, root, run):
    if importlib.util.find_spec(library) is None:
        pytest.skip(f"needs {library}, where the {network} comes from")
    text = run(root / "examples/operators/run.py", "--small", problem).stdout
    sizes = [int(size) for size in re.findall(rf"^(?:{network}|FC) +(\d+)", text, re.M)]
    assert len(sizes) == 2 and sizes[1] == pytest.approx(sizes[0], rel=0.02)


def test_equations_of_motion_help_a_network(root, run):
    text = run(root / "examples/physics_informed/run.py", "--small").stdout
    assert number(text, r"make the error ([\d.]+) times smaller") > 5


def test_a_policy_is_trained_and_evaluated(root, run, tmp_path, capsys):
    """The network that is saved acts as the one that was trained."""
    pytest.importorskip("stable_baselines3", reason="needs stable-baselines3")
    words = ("--steps", "2048", "--threshold", "50", "--save", str(tmp_path / "policy"))
    text = run(root / "examples/train_ppo.py", *words).stdout
    assert "solved" in text
    evaluate.run([str(tmp_path / "policy"), "--env", "physx/Cartpole-v0", "--backend", "dart"])
    trained, saved = (
        re.search(r"^reward .*", each, re.M)[0] for each in (text, capsys.readouterr().out)
    )
    assert trained == saved


def test_normalization_is_part_of_a_saved_policy(root, tmp_path):
    pytest.importorskip("stable_baselines3", reason="needs stable-baselines3")
    from stable_baselines3 import PPO
    from stable_baselines3.common.env_util import make_vec_env
    from stable_baselines3.common.vec_env import VecNormalize

    example = load(root / "examples/train_ppo.py")
    many = VecNormalize(make_vec_env("Pendulum-v1", n_envs=2, seed=0), clip_obs=np.inf)
    model = PPO("MlpPolicy", many, seed=0, device="cpu", n_steps=64, batch_size=64, n_epochs=1)
    model.learn(128)
    example.save(tmp_path / "policy", model, many.obs_rms)
    env = gymnasium.make("Pendulum-v1")
    policy = Policy(tmp_path / "policy", env)
    env.observation_space.seed(0)
    for _ in range(20):
        seen = env.observation_space.sample()
        wanted, _ = model.predict(many.normalize_obs(seen), deterministic=True)
        np.testing.assert_allclose(policy(seen), wanted, atol=1e-5)


def test_heat_is_learned_while_it_is_simulated(root, run, tmp_path):
    pytest.importorskip("matplotlib")
    picture = tmp_path / "online.png"
    words = "--small", "--sessions", str(tmp_path / "sessions"), "--picture", str(picture)
    text = run(root / "examples/online/run.py", *words).stdout
    assert "physx/uniform: 32 simulations" in text and "physx/active: 32 simulations" in text
    assert picture.stat().st_size > 10_000
