"""Components are checked, before a run calls them, for the methods and arguments of their kind."""

import pytest

from physx_core import Environment, Launcher, Network, Sampler, Visualizer, plugins
from physx_core.errors import ConfigError, UnknownOptionError


class Named(Network):
    """Names what its base takes as ``*inputs`` and ``**kwargs``, and takes more than it must."""

    def predict(self, data, gain=1.0):
        return data

    def get_parameters(self):
        return {}

    def forward(self, state, force):
        return state


class Parametric(Environment):
    def reset_parameters(self, mass, stiffness=1.0):
        """Name the values."""


class Wrapped(Launcher):
    def launch(self, *arguments, **options):
        return []


class Static(Visualizer):
    @staticmethod
    def flush():
        """Do nothing."""


@pytest.mark.parametrize(
    ("kind", "component"),
    [
        ("network", Named),
        ("environment", Parametric),
        ("launcher", Wrapped),
        ("visualizer", Static),
    ],
)
def test_a_method_may_name_what_its_base_takes_as_any_arguments(kind, component):
    assert plugins.resolve(kind, component) is component


class Nothing(Network):
    def get_parameters(self, *arguments):
        return {}


class Alone(Named):
    def predict(self):
        return {}


class Greedy(Named):
    def get_gradients(self, scale):
        return {}


class Short(Launcher):
    def launch(self, instances):
        return []


class Unaware(Visualizer):
    def open(self, name):
        """Take the name alone."""

    def events(self, instance_id, events):
        """Take no step."""


class Deaf(Sampler):
    def ask(self):
        return {}


class Classless(Named):
    @classmethod
    def set_seed(cls):
        """Take no seed."""


@pytest.mark.parametrize(
    ("kind", "component", "said"),
    [
        ("network", Nothing, r"The network Nothing is not complete. It lacks: predict\(\); see Ne"),
        ("launcher", Launcher, r"The launcher Launcher is not complete. It lacks: launch\(\)"),
        (
            "network",
            Alone,
            r"The network Alone has predict\(\) where physx calls predict\(data\); ",
        ),
        ("network", Greedy, r"has get_gradients\(scale\) where physx calls get_gradients\(\)"),
        ("launcher", Short, r"Short has launch\(instances\) where physx calls launch\(instances, "),
        ("visualizer", Unaware, r"events\(instance_id, step, events\), and open\(name\) where"),
        ("sampler", Deaf, r"has ask\(\) where physx calls ask\(number\); see Sampler"),
        ("network", Classless, r"has set_seed\(\) where physx calls set_seed\(seed\)"),
    ],
)
def test_methods_that_physx_cannot_call_are_named(kind, component, said):
    with pytest.raises(ConfigError, match=said):
        plugins.resolve(kind, component)


class Options(Wrapped):
    def __init__(self, queue, retries=0):
        if retries < 0:
            raise ValueError("retries must not be negative")


def not_a_launcher():
    return 3


@pytest.mark.parametrize(
    ("component", "arguments", "error", "said"),
    [
        (Options, {}, ConfigError, r"needs queue: .*\(--environment.launcher-kwargs queue=...\)"),
        (Options, {"queue": 1, "retry": 2}, UnknownOptionError, 'no option "retry". Did you mean'),
        (Options, {"queue": 1, "retries": -1}, ConfigError, "ValueError: retries must not be neg"),
        (f"{__name__}:not_a_launcher", {}, ConfigError, "a int, which is not a physx launcher"),
    ],
)
def test_options_that_a_component_does_not_take_are_named(component, arguments, error, said):
    with pytest.raises(error, match=said):
        plugins.create("launcher", component, arguments)


def test_a_component_is_created_with_its_options():
    assert isinstance(plugins.create("launcher", Options, {"queue": "short"}), Options)
