"""After random histories a recording shows what it shows of the same objects without a history."""

import random

import numpy as np
import pytest
import rerun as rr

from physx_core.components import Factory

NAMES = ["a", "b", "a/c", "d e", "f"]
PARTS = ["", "/edges", "/labels"]
KINDS = {
    "box": (["half_sizes"], ["position", "orientation", "color", "alpha", "label", "visible"]),
    "sphere": (["radius"], ["position", "orientation", "color", "wireframe", "visible"]),
    "mesh": (["positions", "cells"], ["field", "color", "wireframe", "size", "visible"]),
    "points": (["positions"], ["field", "labels", "color", "size", "visible"]),
    "symbols": (["positions", "size"], ["orientations", "labels", "symbol", "color", "visible"]),
}
SHAPES = {"half_sizes": (3,), "position": (3,), "orientation": (4,)}


class History:
    """Objects that change at random.

    Attributes:
        objects: Kind and options of each, by name.
        lives: How many objects had a name.
    """

    def __init__(self, number):
        self.factory, self.chance = Factory(), random.Random(number)
        self.objects, self.lives = {}, {}

    def values(self, kind, options, count):
        chance, values = self.chance, {}
        for option in options:
            if option == "field":
                values["scalar_field"] = self.array(count)
                values |= {"vmin": 0.0, "vmax": 2.0}
            elif option in ("positions", "orientations"):
                values[option] = self.array(count, 3)
            elif option in SHAPES:
                values[option] = self.array(*SHAPES[option])
            elif option == "cells":
                values[option] = [[chance.randrange(count) for _ in range(3)] for _ in range(4)]
            elif option == "labels":
                values[option] = chance.choice([[], [f"{chance.random()}" for _ in range(count)]])
            elif option in ("visible", "wireframe"):
                values[option] = chance.random() < 0.6
            else:
                choices = {
                    "alpha": [None, 0.5, 1.0],
                    "color": [None, "red", "#102030"],
                    "label": [None, "one", "two"],
                    "radius": [0.5, 1.0],
                    "size": [0.5, 1.0],
                    "symbol": ["plus", "star", "square"],
                }
                values[option] = chance.choice(choices[option])
        return values

    def array(self, *shape):
        numbers = [0.1 + self.chance.random() for _ in range(int(np.prod(shape)))]
        return np.array(numbers, np.float32).reshape(shape)

    def add(self, name):
        kind = self.chance.choice(sorted(KINDS))
        needed, others = KINDS[kind]
        some = [option for option in others if self.chance.random() < 0.4]
        values = self.values(kind, [*needed, *some], self.chance.choice([3, 5]))
        getattr(self.factory, f"add_{kind}")(name, **values)
        self.objects[name] = kind, {}
        self.lives[name] = self.lives.get(name, 0) + 1
        self.set(name, values)

    def set(self, name, values):
        options = self.objects[name][1]
        if "color" in values:
            options.pop("scalar_field", None)
        options |= values

    def change(self, name):
        kind, options = self.objects[name]
        count = len(options.get("positions", ()))
        free = [option for option in [*KINDS[kind][0], *KINDS[kind][1]] if option != "visible"]
        chosen = [option for option in free if self.chance.random() < 0.3]
        if "positions" in chosen and self.chance.random() < 0.5:  # another length for all
            count = self.chance.choice([3, 5])
            together = {"positions", "cells", "field", "labels", "orientations"}
            chosen = [option for option in free if option in together or option in chosen]
        values = self.values(kind, chosen, count)
        if "scalar_field" in values:
            values.pop("color", None)
        getattr(self.factory, f"update_{kind}")(name, **values)
        self.set(name, values)

    def step(self):
        """Change objects; at most one appears, disappears, or is shown or hidden."""
        chance = self.chance
        for _ in range(chance.randint(0, 3)):
            if self.objects:
                self.change(chance.choice(sorted(self.objects)))
        name = chance.choice(NAMES)
        if name not in self.objects:
            self.add(name)
        elif chance.random() < 0.3:
            self.factory.remove(name)
            del self.objects[name]
        elif chance.random() < 0.5:
            kind, options = self.objects[name]
            options["visible"] = not options.get("visible", True)
            getattr(self.factory, f"update_{kind}")(name, visible=options["visible"])
        for _ in range(chance.randint(0, 3)):
            if self.objects:
                self.change(chance.choice(sorted(self.objects)))


def last_values(path):
    """Return what a recording shows at its end: entity to component to value; and frames' poses."""
    rows, clears = [], []
    for chunk in rr.chunk.RrdReader(path).stream():
        batch = chunk.to_record_batch()
        names = batch.schema.names
        steps = batch.column("step").to_pylist() if "step" in names else [-1] * batch.num_rows
        for row, step in enumerate(steps):
            found = {n: batch.column(n)[row].as_py() for n in names if ":" in n}
            rows.append((step, chunk.entity_path, found))
            if found.get("Clear:is_recursive"):
                clears.append((step, chunk.entity_path, found["Clear:is_recursive"] == [True]))
    shown, poses = {}, {}
    for step, entity, found in sorted(rows, key=lambda row: row[0]):
        if "Transform3D:child_frame" in found:
            pose = found["Transform3D:translation"] + found["Transform3D:quaternion"]
            poses[found["Transform3D:child_frame"][0]] = pose
        elif not any(
            0 <= step <= when and (entity == what or (deep and entity.startswith(f"{what}/")))
            for when, what, deep in clears
        ):
            known = shown.setdefault(entity, {})
            known |= {name: value for name, value in found.items() if value is not None}
    return shown, poses


def objects_in(path, lives):
    """Return what is to be seen of each object, by its name."""
    shown, poses = last_values(path)
    seen = {}
    for name, life in lives.items():
        own = name if life == 1 else f"{name} ({life})"
        entity = "/env_1/" + "/".join(map(rr.escape_entity_path_part, own.split("/")))
        for part in PARTS:
            values = {n: v for n, v in shown.get(entity + part, {}).items() if v}
            frame = values.pop("CoordinateFrame:frame", None)
            if part == "" and frame:
                values["pose"] = poses[frame[0]]
            if part == "" or any(n.endswith((":positions", ":strips")) for n in values):
                seen[name + part] = {n: v for n, v in values.items() if ":" in n or n == "pose"}
    return seen


def compare(opened, tmp_path, number, every):
    """Compare the recording of a random history with one of the objects that are left."""
    history = History(number)
    visualizer = opened(every=every, path=tmp_path / "history.rrd")
    for step in range(60):
        history.step()
        visualizer.events(1, step, history.factory.take_events())
    visualizer.close()
    fresh, factory = opened(path=tmp_path / "fresh.rrd"), Factory()
    for name, (kind, options) in history.objects.items():
        getattr(factory, f"add_{kind}")(name, **options)
    fresh.events(1, 0, factory.take_events())
    fresh.close()
    lives = {name: history.lives[name] for name in history.objects}
    expected = objects_in(fresh.file, dict.fromkeys(lives, 1))
    found = objects_in(visualizer.file, lives)
    assert found.keys() == expected.keys()
    for name, values in expected.items():
        assert (name, found[name]) == (name, values)


@pytest.mark.parametrize(("number", "every"), [(1, 1), (2, 1), (3, 3), (64, 2)])
def test_a_recording_ends_with_the_objects_as_they_are(opened, tmp_path, number, every):
    compare(opened, tmp_path, number, every)


@pytest.mark.faults
@pytest.mark.parametrize("number", range(10, 60))
def test_recordings_of_more_histories(opened, tmp_path, number):
    compare(opened, tmp_path, number, 1 + number % 3)
