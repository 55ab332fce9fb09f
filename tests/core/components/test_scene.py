import numpy as np
import pytest

from physx_core.components import Factory
from physx_core.errors import ConfigError, UnknownOptionError


def test_events_are_copies_and_are_taken_once():
    factory = Factory()
    positions = np.zeros((2, 3))
    factory.add_points("p", positions, color="red")
    positions[:] = 1
    (event,) = factory.take_events()
    assert (event.action, event.kind, event.name) == ("add", "points", "p")
    assert event.values["positions"].sum() == 0
    assert factory.take_events() == []


def test_an_object_is_updated_under_its_name_and_kind():
    factory = Factory()
    factory.add_sphere("ball", 0.1)
    factory.update_sphere("ball", position=[1, 2, 3])
    assert factory.take_events()[1].values["position"].tolist() == [1, 2, 3]
    with pytest.raises(ConfigError, match='"ball" is a sphere, not a box'):
        factory.update_box("ball", position=[0, 0, 0])
    with pytest.raises(ConfigError, match='"bal" does not exist'):
        factory.update_sphere("bal", position=[0, 0, 0])


def test_names_are_unique_and_options_are_checked():
    factory = Factory()
    factory.add_box("a", [1, 1, 1])
    with pytest.raises(ConfigError, match="already"):
        factory.add_sphere("a", 1.0)
    with pytest.raises(UnknownOptionError, match='"colour".*"color"'):
        factory.add_box("b", [1, 1, 1], colour="red")
    with pytest.raises(UnknownOptionError, match="half_sizes"):
        factory.update_box("a", half_sizes=[2, 2, 2])
    with pytest.raises(ConfigError, match=r"positions has shape \(3,\)"):
        factory.add_lines("l", [0, 0, 0])
