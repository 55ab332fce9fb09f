"""A plugin: `template/cloud` is an environment, `template/mlp` a network that learns from it."""

from physx_core import Environment, Field
from physx_core.plugins import hookimpl


class Cloud(Environment):
    def __init__(self, *, points=10, **kwargs):
        super().__init__(**kwargs)
        self.points = points

    def create(self):
        self.center = self.rng.random(3)

    def init_database(self):
        shape = (self.points, 3)
        self.define_training_fields(
            [Field("cloud", shape, unit="m"), Field("mean", (3,), unit="m")]
        )

    def step(self):
        cloud = self.center + self.rng.standard_normal((self.points, 3))
        self.set_training_data(cloud=cloud, mean=cloud.mean(axis=0))


@hookimpl
def physx_environments():
    return {"cloud": Cloud}


@hookimpl
def physx_networks():
    return {"mlp": "physx_template.network:MLP"}  # as text: torch is imported on first use
