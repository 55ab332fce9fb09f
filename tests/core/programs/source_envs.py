"""Environments that replay stored samples, refuse some, and use all that an environment may."""

from __future__ import annotations

import time

import numpy as np

from physx_core import Environment, Field
from physx_core.errors import UsageError


class Picky(Environment):
    """Refuses large numbers; an instance may come to refuse everything, or give nonsense then."""

    def __init__(self, *, spoil: str = "", stuck=(0, 0), late: float = 0.0, **kwargs):
        super().__init__(**kwargs)
        self.spoil, self.stuck, self.late = spoil, stuck, late
        self.state = np.zeros(3)

    def create(self):
        pass

    def init_database(self):
        self.define_training_fields([Field("state", unit="m"), ("number", int)])
        self.define_additional_fields([Field("drawn", shape=(), dtype="float32")])

    def step(self):
        if self.instance_id == 1:
            time.sleep(self.late)
        self.state[:] = self.rng.random(3)  # in place: what is kept must be a copy
        self.set_training_data(state=self.state, number=self.step_index)
        self.set_additional_data(drawn=np.float32(self.rng.random()))
        if self.spoil and self.step_index % 2 and self.is_wrong():
            self.set_training_data(**self.nonsense())

    def nonsense(self):
        return {
            "nan": {"state": np.full(3, np.nan), "number": 1},
            "shape": {"state": np.zeros(4), "number": 1},
            "name": {"state": self.state, "speed": 1},
            "ragged": {"state": [[1.0], [1.0, 2.0]], "number": 1},
            "text": {"state": "text", "number": 1},
        }[self.spoil]

    def is_wrong(self):
        who, begin = self.stuck
        if self.instance_id == who and self.step_index >= begin:
            return True
        return self.state[0] > 0.6

    def check_sample(self):
        return not self.is_wrong()


class Doubling(Environment):
    """Draws x, or takes that of the stored sample, and makes y of it: `factor` times the sum.

    ``times`` counts how often a sample was made, ``seen`` says which row it was: instance, episode
    and step, -1 for none.
    """

    def __init__(self, *, factor: float = 1.0, refuse: int = 0, **kwargs):
        super().__init__(**kwargs)
        self.factor, self.refuse = factor, refuse

    def create(self):
        pass

    def init_database(self):
        self.define_training_fields([Field("x", (2,), unit="m"), ("y", np.ndarray)])
        self.define_additional_fields([("times", int), Field("seen", (3,), dtype="int64")])

    def step(self):
        x, times, seen = self.rng.random(2), 0, [-1, -1, -1]
        if self.sample is not None:
            assert all(type(value) is np.ndarray for value in self.sample.values())
            x, times = self.sample["x"].copy(), self.sample["times"] + 1
            seen = [self.sample[name] for name in ("env_id", "episode", "step")]
            if self.compute_training_data and self.is_accepted():
                self.sample["x"][:] = 0  # its own copy: nobody else sees that
        self.set_training_data(x=x, y=self.factor * x.sum(keepdims=True))
        self.set_additional_data(times=times, seen=seen)

    def is_accepted(self):
        return not self.refuse or self.step_index % self.refuse != 1

    def check_sample(self):
        return self.is_accepted()


class Refusing(Doubling):
    """Refuses every other sample that it makes, and all that it replays."""

    def is_accepted(self):
        return self.sample is None and self.step_index % 2 == 0


class Asking(Doubling):
    """Keeps the network's answer for its x in the field ``answer``."""

    def init_database(self):
        super().init_database()
        self.define_additional_fields(Field("answer", (1,)))

    def step(self):
        super().step()
        x, training = self._training["x"], dict(self._training)
        answer = self.get_prediction(x=x)["y"]
        self.set_training_data(**training)
        self.set_additional_data(**self._additional, answer=answer)


class Everything(Environment):
    """Does all that an environment may do, and tells with its fields and parameters what it saw."""

    def __init__(self, *, size: int = 3, **kwargs):
        super().__init__(**kwargs)
        self.size, self.sub_steps, self.applied = size, 0, []

    def create(self):
        self.before = self.load_parameters()
        self.save_parameters(options={"size": self.size}, table=np.arange(self.size, dtype="int8"))

    def init(self):
        self.state = np.zeros(self.size)

    def init_database(self):
        self.define_training_fields([("state", np.ndarray), Field("target", shape=())])
        self.define_additional_fields([("sub_steps", int), ("flag", bool), ("last", float)])

    def init_visualization(self):
        self.factory.add_points("cloud", np.zeros((self.size, 3)), color="red")

    async def step(self):
        assert self.sample is None or self.sample["state"].shape == (self.size,)
        self.state = self.state + self.rng.normal(size=self.size)
        if not self.compute_training_data:
            self.sub_steps += 1
            return
        if self.factory:
            self.factory.update_points("cloud", positions=np.outer(self.state, [1, 0, 0]))
            self.update_visualization()
        answer = self.get_prediction(x=self.state)["y"]
        if self.step_index % 4 == 3:
            self.new_episode()
        self.set_training_data(state=self.state, target=answer.sum())
        last = self.applied[-1] if self.applied else 0.0
        self.set_additional_data(sub_steps=self.sub_steps, flag=last > 0, last=last)

    def check_sample(self):
        return self.state[0] * 10 % 1 < 0.7

    def apply_prediction(self, prediction):
        self.applied.append(float(prediction["y"].sum()))
        self.state = 0.5 * self.state

    def close(self):
        self.save_parameters(closed=True, applied=self.applied, sub_steps=self.sub_steps)


class Keeping(Doubling):
    """Counts the runs that it took part in with the parameters that it keeps."""

    kept: dict = {}  # noqa: RUF012 - never changed in place

    def init(self):
        self.kept = self.load_parameters()
        runs = self.kept.get("runs", 0) + 1
        self.save_parameters(runs=runs, who=(self.instance_id, "name"), table=np.full(2, runs))
        self.save_parameters(late=True)

    def close(self):
        self.save_parameters(steps=self.kept.get("steps", 0) + self.step_index)


class AskingOnlyInTraining(Asking):
    """Asks the network where there is one."""

    def get_prediction(self, **fields):
        try:
            return super().get_prediction(**fields)
        except UsageError:
            return {"y": np.zeros(1)}


class Applying(Doubling):
    """Tells in ``seen`` what was applied last, in millionths."""

    applied = 0

    def step(self):
        super().step()
        self.set_additional_data(times=0, seen=np.full(3, self.applied))

    def apply_prediction(self, prediction):
        assert prediction["y"].shape == (1,)
        self.applied = int(1e6 * prediction["y"].item())


class LeavesDrawn(Doubling):
    """Draws in every method that may, and sends itself what it draws in every third step."""

    def init_visualization(self):
        self.factory.add_sphere("x", 0.1)
        self.factory.add_text("told", "nothing")

    def step(self):
        super().step()
        if self.step_index != 3:
            self.factory.update_sphere("x", position=[self.step_index, 0, 0])
        if self.step_index % 3 == 1:
            self.update_visualization()

    def check_sample(self):
        if self.step_index == 4:
            self.factory.update_text("told", "checked")
        return self.step_index != 2

    def apply_prediction(self, prediction):
        self.factory.update_text("told", f"applied {len(prediction)}")


class Broken(Doubling):
    """Fails in one method, and then cannot be closed either."""

    def __init__(self, *, method: str, **kwargs):
        super().__init__(**kwargs)
        self.method = method

    def create(self):
        if self.method == "create":
            raise ValueError("the first mistake")

    def step(self):
        raise ValueError("the first mistake")

    def close(self):
        raise ValueError("what follows from it")
