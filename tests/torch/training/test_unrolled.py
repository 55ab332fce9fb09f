"""Networks that learn from several steps of their own predictions."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from physx_core import (
    Dataset,
    DatasetConfig,
    EnvironmentConfig,
    Field,
    NetworkConfig,
    Training,
    View,
)
from physx_core.cli import main
from physx_core.errors import ConfigError, DatasetError

LENGTH, EPISODES = 12, 10


@pytest.fixture(autouse=True)
def in_a_folder_of_its_own(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


def states():
    """Return states and forces of a damped oscillation, shape (episodes, rows + 1, 2)."""
    rng = np.random.default_rng(0)
    force = rng.normal(size=(EPISODES, LENGTH + 1, 2))
    state = np.empty_like(force)
    state[:, 0] = 5 + rng.normal(size=(EPISODES, 2))
    turn = 0.9 * np.array([[np.cos(0.5), np.sin(0.5)], [-np.sin(0.5), np.cos(0.5)]])
    for row in range(LENGTH):
        state[:, row + 1] = state[:, row] @ turn + 0.3 * force[:, row]
    return state, force


def store(**more):
    """Store each row's state, the state after it, and the force."""
    state, force = states()
    flat = {"state": state[:, :-1], "after": state[:, 1:], "force": force[:, :-1], **more}
    rows = {name: values.reshape(-1, 2) for name, values in flat.items()}
    episode, step = np.divmod(np.arange(EPISODES * LENGTH), LENGTH)
    with Dataset.create("data") as dataset:
        fields = [Field("state", (2,)), Field("after", (2,), like="state"), Field("force", (2,))]
        counts = [Field(name, (), "int64", role="additional") for name in ("episode", "step")]
        dataset.define_fields("training", [*fields, *counts])
        dataset.append("training", {**rows, "episode": episode, "step": step})


class Map(torch.nn.Module):
    """A linear map of all inputs, with a tanh."""

    def __init__(self, inputs, outputs, shape=(2,)):
        super().__init__()
        self.map, self.shape = torch.nn.Linear(inputs, outputs), shape

    def forward(self, *inputs):
        flat = torch.cat([each.flatten(1) for each in inputs], dim=1)
        return torch.tanh(self.map(flat)).unflatten(1, self.shape)


class Watched(Training):
    """Keeps the parameters after each batch, and may stop by an error."""

    stops_after = None

    def train_begin(self):
        self.found = []

    def batch_end(self):
        state = self.learner.network.state_dict()
        self.found.append((self.losses["loss"], {n: v.clone() for n, v in state.items()}))
        if self.stops_after == len(self.found) + self._resumed.batches_read:
            raise RuntimeError("stopped here")


def training(window, module, fields, *, normalize=False, **options):
    config = NetworkConfig(
        Map, {**module, **fields}, loss="MSELoss", optimizer="SGD", lr=0.1, device="cpu",
        data_type="float64",
    )  # fmt: skip
    view = View(window=window)
    data = DatasetConfig(existing_dir="data", normalize=normalize, view=view)
    given = {"epoch_nb": 1, "batch_size": 16, "seed": 0, "quiet": True, "rivals": "none"}
    return Watched(config, data, **{**given, **options})


ONE = {"net_fields": "past", "opt_fields": "next"}
KINDS = {
    "windows": ({"past": ("state", 0), "next": ("state", 1)}, (2, 2), ONE, [0], [1]),
    "history": (
        {"past": ("state", [-2, 0, -1]), "next": ("state", 1)},
        *((6, 2), ONE, [-2, 0, -1], [1]),
    ),
    "several rows at once": (
        {"past": ("state", [-1, 0]), "next": ("state", [1, 2])},
        *((4, 4, (2, 2)), ONE, [-1, 0], [1, 2]),
    ),
    "larger steps": ({"past": ("state", 0), "next": ("state", 2)}, (2, 2), ONE, [0], [2]),
    "with a force": (
        {"past": ("state", 0), "next": ("state", 1)},
        *((4, 2), {"net_fields": ["past", "force"], "opt_fields": "next"}, [0], [1]),
    ),
    "the state after a row": (
        {},
        *((4, 2), {"net_fields": ["state", "force"], "opt_fields": "after"}, [0], [1]),
    ),
}


def reference(kind, module, rows, steps, means):
    """Return the loss of a batch, computed step by step from the reference rows of its items."""
    _, _, fields, past, following = KINDS[kind]
    state, force = (torch.from_numpy(values) for values in states())
    episode, step = np.divmod(rows, LENGTH)
    known = {at: state[episode, step + at] for at in past}
    losses, names = [], [fields["net_fields"], fields["opt_fields"]]
    first = names[0] if isinstance(names[0], str) else names[0][0]
    (m0, s0), (m1, s1) = (means.get(name, (0.0, 1.0)) for name in (first, names[1]))
    (mf, sf) = means.get("force", (0.0, 1.0))
    for each in range(steps):
        begin = each * max(following)
        inputs = (torch.stack([known[begin + at] for at in past], dim=1) - m0) / s0
        others = (
            [(force[episode, step + begin] - mf) / sf] if "force" in fields["net_fields"] else []
        )
        output = module(inputs, *others).reshape(len(rows), len(following), 2)
        truth = torch.stack([state[episode, step + begin + at] for at in following], dim=1)
        if means.get("increment"):
            last = known[begin + max(past)][:, None]
            losses.append((output - (truth - last - m1) / s1).square().mean())
            predicted = output * s1 + m1 + last
        else:
            losses.append((output - (truth - m1) / s1).square().mean())
            predicted = output * s1 + m1
        known |= {begin + at: predicted[:, i] for i, at in enumerate(following)}
    return torch.stack(losses).mean()


CASES = [(kind, normalize) for kind in KINDS for normalize in (False, True, "increment")]
CASES.remove(("several rows at once", "increment"))  # which has no increments
CASES.remove(("history", "increment"))  # since the last one of them: see Increments


@pytest.mark.parametrize(("kind", "normalize"), CASES)
@pytest.mark.reported(
    "PINA#731",
    "PDEBench#5",
    "neuraloperator#529",
    about="training on rollouts, and its off-by-one errors",
)
def test_the_loss_and_its_gradient_are_those_of_all_steps(kind, normalize):
    store()
    window, sizes, fields, past, following = KINDS[kind]
    target = fields["opt_fields"]
    by = {target: "increment"} if normalize == "increment" else normalize
    module = dict(zip(("inputs", "outputs", "shape"), sizes, strict=False))
    steps = 3
    with training(window, module, fields, normalize=by, unroll=[steps]) as run:
        run.train_begin()
        run.epoch_begin()
        run.batch_begin()
        network = run.learner.network.module
        twin = Map(**module).double()
        twin.load_state_dict(network.state_dict())
        (rows,) = run.data.stored._read.rows(0)
        known = run.learner.transformation.normalization
        means = {name: (torch.tensor(n.mean), torch.tensor(n.std)) for name, n in known.items()}
        loss = reference(kind, twin, rows, steps, {**means, "increment": normalize == "increment"})
        loss.backward()
        run.batch_produce()
        run.optimize()
        assert run.losses["loss"] == pytest.approx(loss.item(), rel=1e-9)
        expected = {n: p.detach() - 0.1 * p.grad for n, p in twin.named_parameters()}
        for name, parameter in network.named_parameters():
            torch.testing.assert_close(parameter.detach(), expected[name])
        run.batch_count()
    assert max(rows % LENGTH) + max(past) + steps * max(following) <= LENGTH


def windows(**options):
    return training(*KINDS["windows"][:1], {"inputs": 2, "outputs": 2}, ONE, **options)


def test_the_number_of_steps_grows_by_epoch_while_the_samples_stay_the_same():
    store()
    found = []
    schedules = {"late": [1, 1, 3], "grows": [1, 3], "stays": [1, 3, 3]}
    for name, schedule in schedules.items():
        run = windows(unroll=schedule, epoch_nb=3, session_name=name, normalize=True)
        run.execute()
        found.append([loss for loss, _ in run.found])
    batches = len(found[1]) // 3
    assert found[0][:batches] == found[1][:batches] and found[0][batches] != found[1][batches]
    assert found[1] == found[2]


def test_validation_has_one_step():
    store()
    run = windows(unroll=[4], normalize=True)
    run.execute()
    again = windows(normalize=True, session_name="again")
    again.network_config = NetworkConfig(
        **{**vars(run.network_config), "network_dir": run.session.path, "lr": 0.0}
    )
    again.execute()
    assert again.validation_loss == run.validation_loss


@pytest.mark.parametrize("after", [2, 7])
def test_an_unrolled_training_with_noise_that_was_stopped_goes_on_bit_for_bit(after):
    store()
    options = {"unroll": [2, 3], "noise": 0.1, "epoch_nb": 2, "normalize": True}
    whole = windows(session_name="whole", **options)
    whole.execute()
    first = windows(session_name="halves", **options)
    first.stops_after = after
    with pytest.raises(RuntimeError, match="stopped here"):
        first.execute()
    second = windows(session_name="halves", resume=True, **options)
    second.execute()
    for (own, mine), (other, its) in zip(second.found, whole.found[after:], strict=True):
        assert own == other
        assert all(torch.equal(mine[name], its[name]) for name in mine)


def test_noise_is_in_standard_deviations_and_only_on_what_is_fed_back():
    store()
    window, _, fields, *_ = KINDS["with a force"]
    inputs = []

    class Seeing(Map):
        def forward(self, *given):
            inputs.append([each.detach().clone() for each in given])
            return super().forward(*given)

    def seen(noise):
        inputs.clear()
        run = training(window, {"inputs": 4, "outputs": 2}, fields, normalize=True, noise=noise,
                       session_name=f"noise{noise}", batch_size=80)  # fmt: skip
        run.network_config = NetworkConfig(**{**vars(run.network_config), "network": Seeing})
        run.execute()
        return inputs[0]

    (past, force), (noisy, same) = seen(0.0), seen(0.5)
    assert torch.equal(force, same)
    difference = noisy - past
    assert 0.4 < difference.std().item() < 0.6 and abs(difference.mean().item()) < 0.15


@pytest.mark.parametrize(
    ("window", "options", "reason"),
    [
        ({"past": ("state", 0), "next": ("state", 1)}, {"unroll": [0]}, "at least 1"),
        ({"past": ("state", 0), "next": ("force", 1)}, {"unroll": [2]}, "there is none"),
        ({"past": ("state", 0), "next": ("state", -1)}, {"unroll": [2]}, "later time"),
        ({"past": ("state", [-1, 0]), "next": ("state", 2)}, {"unroll": [2]}, r"\[1\] are neither"),
        ({"past": ("state", 0), "next": ("state", 1)}, {"noise": 0.1}, "normalize it"),
    ],
)
def test_what_cannot_be_unrolled_is_refused(window, options, reason):
    store()
    with pytest.raises(ConfigError, match=reason):
        training(window, {"inputs": 2, "outputs": 2}, ONE, **options).execute()


def test_rows_that_do_not_continue_each_other_are_refused():
    store(after=np.random.default_rng(1).normal(size=(EPISODES, LENGTH, 2)))
    fields = {"net_fields": "state", "opt_fields": "after"}
    with pytest.raises(ConfigError, match="goes on with the next row"):
        training({}, {"inputs": 2, "outputs": 2}, fields, unroll=[2]).execute()


def test_environments_and_rows_of_unknown_trajectories_are_refused():
    with Dataset.create("data") as dataset:
        rows = np.random.default_rng(0).normal(size=(40, 2))
        dataset.append("training", {"state": rows[:-1], "after": rows[1:]})
    with pytest.raises(DatasetError, match="episode"):
        windows(unroll=[2]).execute()
    environment = EnvironmentConfig("toy/spring", as_tcp_ip_client=False)
    fields = {"layers": [2, 2], "net_fields": "state", "opt_fields": "next_state"}
    network = NetworkConfig("torch/fc", fields, loss="MSELoss", optimizer="Adam")
    with pytest.raises(ConfigError, match="generate or replay single rows"):
        Training(network, None, environment, epoch_nb=1, batch_nb=2, batch_size=4, unroll=[2],
                 quiet=True).execute()  # fmt: skip


@pytest.mark.slow
def test_unrolling_from_the_command_line(capsys):
    store()
    words = [
        *("train", "--dataset.existing-dir", "data", "--dataset.normalize", "--seed", "0"),
        *("--network.network", "torch/fc", "--network.network-kwargs", "layers=[2,8,2]"),
        *("net_fields=past", "opt_fields=next", "--network.loss", "MSELoss"),
        *("--network.optimizer", "Adam", "--epoch-nb", "2", "--batch-size", "16"),
        *("--dataset.view.window", "past={field='state',at=0}", "next={field='state',at=1}"),
        *("--unroll", "1", "3", "--noise", "0.01", "--session-name", "run"),
    ]
    assert main(words) == 0
    told = "".join(capsys.readouterr())
    assert "unrolled: 1, 3 steps by epoch, which feed back next as past, with noise" in told
    assert main(["train", "sessions/run", "--resume", "--epoch-nb", "3"]) == 0
