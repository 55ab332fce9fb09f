from __future__ import annotations

import numpy as np
import pytest

from physx_core.components import Factory
from physx_core.components.scene.kinds import KINDS
from physx_core.errors import ConfigError, UnknownOptionError

SQUARE = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], float)
CELLS = np.array([[0, 1, 2], [0, 2, 3]])
EXAMPLES = {
    "mesh": {"positions": SQUARE, "cells": CELLS},
    "points": {"positions": SQUARE},
    "arrows": {"positions": SQUARE, "vectors": SQUARE},
    "symbols": {"positions": SQUARE},
    "markers": {"mesh": "plate", "indices": [0, 2]},
    "lines": {"positions": SQUARE},
    "box": {"half_sizes": [1, 2, 3]},
    "sphere": {"radius": 1.0},
    "capsule": {"radius": 1.0, "length": 2.0},
    "cylinder": {"radius": 1.0, "length": 2.0},
    "height_field": {"heights": np.zeros((2, 3)), "spacing": [1, 1]},
    "slice": {"values": np.zeros((2, 3)), "spacing": [1, 1]},
    "volume": {"values": np.zeros((2, 3, 4)), "spacing": [1, 1, 1]},
    "image": {"image": np.zeros((4, 5), np.uint8)},
    "text": {"content": "one"},
    "scalars": {"labels": ["x", "y"]},
    "robot": {"urdf": "arm.urdf", "bodies": ["a", "b"]},
}


@pytest.fixture
def factory():
    """Return a factory with an object of each kind, named like it."""
    made = Factory()
    made.add_mesh("plate", SQUARE, CELLS)
    for kind, values in EXAMPLES.items():
        getattr(made, f"add_{kind}")(kind, **values)
    made.take_events()
    return made


def test_events_are_copies_and_are_taken_once():
    factory = Factory()
    positions = np.zeros((2, 3))
    factory.add_points("p", positions, color="red")
    positions[:] = 1
    (event,) = factory.take_events()
    assert (event.action, event.kind, event.names) == ("add", "points", ("p",))
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


def test_names_are_unique_and_options_are_checked(factory):
    with pytest.raises(ConfigError, match="already"):
        factory.add_sphere("box", 1.0)
    with pytest.raises(UnknownOptionError, match='"colour".*"color"'):
        factory.add_box("b", [1, 1, 1], colour="red")
    with pytest.raises(UnknownOptionError, match="urdf"):
        factory.update_robot("robot", urdf="leg.urdf")
    with pytest.raises(UnknownOptionError, match="position"):
        factory.update_mesh("mesh", position=[0, 0, 0])


def test_every_kind_has_an_example():
    assert KINDS.keys() - EXAMPLES.keys() == {"controls", "view"}


WRONG = [
    ("mesh", {"positions": [[np.nan, 0, 0], *SQUARE[1:]]}, r"is nan at index \(0, 0\)"),
    ("mesh", {"positions": SQUARE[:3]}, "index 3, but positions has only the 3 vertices 0 to 2"),
    ("mesh", {"cells": [[0, 1, 4]]}, "index 4, but positions has only the 4 vertices"),
    ("mesh", {"cells": [[0, 1, -1]]}, "negative index -1"),
    ("mesh", {"cells": [[0, 1, 0.5]]}, "not indices"),
    ("mesh", {"scalar_field": [1, 2, 3]}, "length 3, but positions has length 4"),
    ("mesh", {"scalar_field": [1, 2, 3, np.inf]}, "is inf at index"),
    ("mesh", {"vmin": 1.0, "vmax": 0.0}, "vmin is 1 but must be less than vmax, 0"),
    ("mesh", {"colormap": "viridi"}, 'Did you mean "viridis"'),
    ("mesh", {"wireframe": "yes"}, "must be True or False"),
    ("points", {"positions": SQUARE[:, :2]}, r"has shape \(4, 2\), expected \(n, 3\)"),
    ("points", {"positions": [[0, 0], [1, 2, 3]]}, "not an array"),
    ("points", {"positions": [["a", "b", "c"]]}, "not an array of numbers"),
    ("points", {"labels": ["a"]}, "labels has length 1, but positions has length 4"),
    ("points", {"size": 0}, "size is 0 but must be a finite number greater than 0"),
    ("points", {"color": "gren"}, 'Did you mean "green"'),
    ("points", {"color": (1, 2, 3)}, "color"),
    ("points", {"alpha": 1.5}, "alpha is 1.5 but must be a finite number at least 0 and at most 1"),
    ("arrows", {"vectors": SQUARE[:2]}, "vectors has length 2, but positions has length 4"),
    ("symbols", {"orientations": SQUARE[:2]}, "orientations has length 2"),
    ("markers", {"indices": [4]}, 'indices goes from 4 to 4, but the mesh "plate"'),
    ("lines", {"positions": [SQUARE, SQUARE[0]]}, "has shape"),
    ("box", {"half_sizes": [1, 2]}, "has shape"),
    ("box", {"position": [0, 0]}, r"has shape \(2,\), expected \(3,\)"),
    ("box", {"position": [0, 0, np.nan]}, r"is nan at index \(2,\)"),
    ("box", {"position": [0, 0, 0], "orientation": [0, 0, 0, 1e39]}, "is inf"),
    ("sphere", {"radius": -1}, "radius is -1"),
    ("capsule", {"length": "long"}, "length is 'long'"),
    ("height_field", {"scalar_field": np.zeros((3, 2))}, r"length \(3, 2\), but heights"),
    ("slice", {"values": np.full((2, 3), np.nan)}, "is nan"),
    ("image", {"image": np.zeros((4, 5, 2), np.uint8)}, r"shape \(4, 5, 2\)"),
    ("image", {"image": np.full((4, 5), 2.0)}, r"floats in \[0, 1\]"),
    ("scalars", {"values": [1.0]}, "values has length 1, but labels has length 2"),
    ("scalars", {"values": [1.0, np.nan]}, "is nan"),
    ("robot", {"poses": np.zeros((3, 7))}, "poses has length 3, but bodies has length 2"),
    ("robot", {"poses": np.zeros((0, 7))}, "poses has length 0, but bodies has length 2"),
    ("scalars", {"values": []}, "values has length 0, but labels has length 2"),
    ("points", {"positions": [["1", "2", "3"]]}, "not an array of numbers"),
    ("points", {"positions": 1j * SQUARE}, "not an array of numbers"),
    ("points", {"size": 10**400}, "must be a finite number"),
    ("points", {"labels": np.array("a")}, "must be a list of strings"),
    ("symbols", {"symbol": np.array(["plus", "star"])}, "must be one of"),
]


@pytest.mark.parametrize(("kind", "changes", "message"), WRONG)
def test_what_does_not_fit_is_an_error_that_names_the_object(factory, kind, changes, message):
    with pytest.raises(ConfigError, match=rf'"{kind}".*{message}'):
        getattr(factory, f"update_{kind}")(kind, **changes)
    values = EXAMPLES[kind] | changes
    with pytest.raises(ConfigError, match=rf'"another".*{message}'):
        getattr(factory, f"add_{kind}")("another", **values)
    assert factory.take_events() == []


def test_a_refused_change_changes_nothing(factory):
    with pytest.raises(ConfigError):
        factory.update_points("points", positions=SQUARE[:2], scalar_field=[1, 2, 3])
    factory.update_points("points", scalar_field=[1, 2, 3, 4])
    with pytest.raises(ConfigError, match="scalar_field has length 4, but positions has length 2"):
        factory.update_points("points", positions=SQUARE[:2])
    factory.update_points("points", positions=SQUARE[:2], scalar_field=None)
    factory.update_points("points", positions=SQUARE[:3])


def test_moves_in_a_row_are_one_event():
    factory = Factory()
    for name in "abc":
        factory.add_box(name, [1, 1, 1])
    factory.take_events()
    factory.update_box("a", position=(1, 2, 3), orientation=[0, 0, 0, 1])
    factory.update_box("c", position=np.array([4, 5, 6]), orientation=np.array([0, 0, 1, 0]))
    factory.update_box("b", position=[7, 8, 9])
    both, alone = factory.take_events()
    assert both.names == ("a", "c")
    assert both.values["position"].tolist() == [[1, 2, 3], [4, 5, 6]]
    assert both.values["orientation"].tolist() == [[0, 0, 0, 1], [0, 0, 1, 0]]
    assert [one.name for one in both.each()] == ["a", "c"]
    assert [one.values["position"].tolist() for one in both.each()] == [[1, 2, 3], [4, 5, 6]]
    assert alone.names == ("b",)
    assert alone.values["position"].tolist() == [7, 8, 9]


def test_several_objects_are_changed_in_one_call():
    factory = Factory()
    for name in "abc":
        factory.add_points(name, SQUARE)
        factory.add_sphere(f"ball {name}", 0.1)
    factory.take_events()
    balls = ["ball a", "ball c"]
    factory.update_many("sphere", balls, {"position": [[1, 2, 3], [4, 5, 6]]})
    factory.update_many("sphere", balls, {"color": ["red", "blue"], "radius": [1, 2]})
    factory.update_many("points", ["a"], {"positions": SQUARE[np.newaxis] + 1})
    factory.update_many("points", [], {"positions": np.zeros((0, 4, 3))})
    moved, *colored, points = factory.take_events()
    assert moved.names == ("ball a", "ball c")
    assert [(one.name, dict(one.values)) for one in colored] == [
        ("ball a", {"color": "red", "radius": 1}),
        ("ball c", {"color": "blue", "radius": 2}),
    ]
    assert points.values["positions"].tolist() == (SQUARE + 1).tolist()
    with pytest.raises(ConfigError, match='"ball c".*is nan at'):
        factory.update_many("sphere", balls, {"position": [[0, 0, 0], [0, np.nan, 0]]})
    with pytest.raises(ConfigError, match=r'"ball a".*has shape \(1, 3\), expected \(2, 3\)'):
        factory.update_many("sphere", balls, {"position": [[0, 0, 0]]})
    with pytest.raises(ConfigError, match='"ball c".*color.*"gren"'):
        factory.update_many("sphere", balls, {"color": ["green", "gren"]})
    with pytest.raises(ConfigError, match='"ball b" is a sphere, not a points'):
        factory.update_many("points", ["a", "ball b"], {"positions": np.zeros((2, 4, 3))})
    with pytest.raises(UnknownOptionError, match="heading"):
        factory.update_many("sphere", balls, {"heading": [1, 2]})


def test_markers_follow_their_mesh(factory):
    factory.update_mesh("plate", positions=SQUARE[:, [0, 2, 1]])
    _, markers = factory.take_events()
    assert (markers.kind, markers.name) == ("symbols", "markers")
    assert markers.values["positions"].tolist() == SQUARE[[0, 2]][:, [0, 2, 1]].tolist()
    assert markers.values["orientations"].tolist() == [[0, -1, 0], [0, -1, 0]]
    with pytest.raises(ConfigError, match='no mesh "sheet" to mark. Meshes: mesh, plate'):
        factory.add_markers("others", "sheet", [0])


def test_names_of_removed_objects_can_be_used_again(factory):
    factory.remove("box", "plate")
    removed = [(event.action, event.name) for event in factory.take_events()]
    assert removed == [("remove", "box"), ("remove", "markers"), ("remove", "plate")]
    factory.add_sphere("box", 1.0)
    with pytest.raises(ConfigError, match='no object "plate" to remove'):
        factory.remove("plate")
    with pytest.raises(ConfigError, match='"markers" does not exist'):
        factory.update_markers("markers", indices=[0])


def test_changes_of_several_objects_are_made_together_or_not_at_all(factory):
    factory.add_points("fixed", SQUARE, scalar_field=[1, 2, 3, 4])
    factory.take_events()
    with pytest.raises(ConfigError, match='"fixed".*length 4, but positions has length 2'):
        factory.update_many("points", ["points", "fixed"], {"positions": np.zeros((2, 2, 3))})
    factory.update_points("points", labels=list("abcd"))
    assert [dict(event.values) for event in factory.take_events()] == [{"labels": list("abcd")}]
    factory.update_many("points", ["points", "fixed"], {"color": [None, "red"]})
    assert [event.values["color"] for event in factory.take_events()] == [None, "red"]
    factory.update_many("markers", ["markers", "markers"], {})
    assert factory.take_events() == []
    with pytest.raises(ConfigError, match='"points".*not an array'):
        factory.update_many("points", ["points", "fixed"], {"positions": [SQUARE, SQUARE[:2]]})
    with pytest.raises(UnknownOptionError, match='"view"'):
        factory.update_many("view", ["view"], {"title": ["other"]})


def test_marked_vertices_stay(factory):
    with pytest.raises(ConfigError, match='"plate".*the markers "markers" are on vertex 2'):
        factory.update_mesh("plate", positions=SQUARE[:2], cells=CELLS[:0])
    with pytest.raises(ConfigError, match='"markers": indices goes from 9'):
        factory.update_markers("markers", indices=[9], labels=["one"])
    factory.update_markers("markers", labels=["one", "two"])
    factory.update_markers("markers", indices=[0, 1])
    factory.take_events()
    factory.update_mesh("plate", positions=SQUARE[:2], cells=CELLS[:0])
    assert [event.name for event in factory.take_events()] == ["plate", "markers"]


def test_markers_stay_where_a_refused_change_of_several_meshes_began(factory):
    factory.update_mesh("mesh", scalar_field=[1, 2, 3, 4])
    factory.take_events()
    with pytest.raises(ConfigError, match='"mesh".*length 4, but positions has length 5'):
        factory.update_many("mesh", ["plate", "mesh"], {"positions": np.ones((2, 5, 3))})
    factory.update_markers("markers", indices=[1])
    (markers,) = factory.take_events()
    assert markers.values["positions"].tolist() == [[1, 0, 0]]


def test_large_numbers_need_no_warning(factory):
    for dtype, large in ((np.float16, 6e4), (np.float32, 1e30), (np.float64, 1e38)):
        factory.update_points("points", positions=np.full((4, 3), large, dtype))


@pytest.mark.parametrize("seconds", [np.nan, np.inf, "now", None])
def test_simulated_time_is_a_number(factory, seconds):
    with pytest.raises(ConfigError, match="The simulated time is .* but must be a finite number"):
        factory.set_time(seconds)
    assert factory.take_events() == []
