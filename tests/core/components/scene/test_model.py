"""Random histories of calls of a factory, each compared with the simplest possible model.

The model is one dict of each object's options, and the list of what happened to it. Every number
that is given is a new one, so that any mix-up shows.
"""

import contextlib
import itertools
import random

import numpy as np
import pytest
from hypothesis import seed, settings
from hypothesis import strategies as st
from hypothesis.stateful import (
    RuleBasedStateMachine,
    initialize,
    precondition,
    rule,
    run_state_machine_as_test,
)
from sizes import size

from physx_core.components import Factory
from physx_core.errors import ConfigError

QUICK = settings(database=None, max_examples=size(15, 4), stateful_step_count=50)
LONG = settings(QUICK, max_examples=40)

CHANCE = st.integers(0, 2**32 - 1).map(random.Random)
NAMES = ["a", "b", "a/c", "d e", "f", "g"]
POSE = ["position", "orientation"]
OPTIONS = {
    "mesh": ["positions", "cells", "scalar_field", "color", "vmin", "vmax", "wireframe", "size"],
    "points": ["positions", "scalar_field", "labels", "color", "alpha", "visible", "vmin", "vmax"],
    "arrows": ["positions", "vectors", "scalar_field", "labels"],
    "symbols": ["positions", "orientations", "scalar_field", "labels", "symbol"],
    "markers": ["mesh", "indices", "scalar_field", "labels", "color", "size"],
    "box": ["half_sizes", *POSE, "color", "label", "visible"],
    "sphere": ["radius", *POSE, "alpha"],
    "height_field": ["heights", "spacing", *POSE, "scalar_field"],
    "scalars": ["labels", "values"],
    "robot": ["urdf", "bodies", "poses"],
}
NEEDED = {
    "mesh": 2,
    "arrows": 2,
    "markers": 2,
    "height_field": 2,
    "robot": 2,
}  # of all others the first
FIXED = {"markers": ["mesh"], "scalars": ["labels"], "robot": ["urdf", "bodies"]}
ALIGNED = {"positions", "vectors", "orientations", "scalar_field", "labels", "indices", "values"}
ALIGNED |= {"heights", "bodies", "poses"}
EMPTY_IS_NONE = {"scalar_field", "labels", "orientations"}
RESETTABLE = {"color", "scalar_field", "vmin", "vmax", "size", "label", "alpha"}
SHAPES = {
    "positions": ("n", 3),
    "vectors": ("n", 3),
    "orientations": ("n", 3),
    "scalar_field": ("n",),
    "values": ("n",),
    "poses": ("n", 7),
    "heights": (2, "n"),
    "position": (3,),
    "orientation": (4,),
    "half_sizes": (3,),
    "spacing": (2,),
}
WORDS = {
    "color": (["red", "#00ff00", [0.5, 0, 1]], ["gren", (0, 0, 2), (np.nan, 0, 0), 7]),
    "alpha": ([0, 0.5, np.float32(1)], [-1, 1.5, np.nan, "much", None]),
    "size": ([0.5, 2], [0, -1, np.inf, 10**400, True]),
    "radius": ([0.5, 2], [0, -1, np.nan, 10**400, None]),
    "wireframe": ([True, np.False_], [1, "yes", None]),
    "visible": ([True, np.False_], [1, "yes", None]),
    "symbol": (["star", "plus"], ["stars", 3, np.array(["star", "plus"])]),
    "label": (["one", 2], []),
    "urdf": (["arm.urdf"], []),
}


def plain(option, value):
    """What is to be seen of a value that is right."""
    if option in SHAPES:
        return np.array(value, np.float64 if option in ("values", "poses") else np.float32)
    if option in ("cells", "indices"):
        return np.array(value, np.int32)
    if option in ("labels", "bodies"):
        return [str(each) for each in value]
    return str(value) if option in ("label", "mesh", "urdf") else value


def needed(kind):
    return OPTIONS[kind][: NEEDED.get(kind, 1)]


def changeable(kind):
    return [option for option in OPTIONS[kind] if option not in FIXED.get(kind, ())]


def is_set(kind, option, value):
    is_empty = option in EMPTY_IS_NONE and option not in needed(kind) and not np.size(value)
    return value is not None and not is_empty


def normal(values):
    """Options in a form that compares: those that are not set do not count."""
    return {
        option: [np.round(value, 5).tolist(), str(value.dtype), value.shape]
        if isinstance(value, np.ndarray)
        else list(value)
        if isinstance(value, tuple)
        else value
        for option, value in values.items()
    }


def normals_of(mesh):
    """Unit normals of a mesh's vertices, one after another."""
    normals = np.zeros((len(mesh["positions"]), 3))
    for cell in mesh["cells"]:
        a, b, c = mesh["positions"][cell].astype(float)
        for vertex in cell:
            normals[vertex] += np.cross(b - a, c - a)
    return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)


class Machine(RuleBasedStateMachine):
    """A factory, its model, and what is to be seen of the events that were taken."""

    def __init__(self):
        super().__init__()
        self.factory = Factory()
        self.numbers = itertools.count(1)
        self.kinds, self.options = {}, {}  # of all objects, by name
        self.happened, self.seen = {}, {}  # (action, kind, options) of each object, in order
        self.shown = {}
        self.few = sorted(OPTIONS)

    @initialize(chance=CHANCE)
    def begin(self, chance):
        """Take few kinds of objects, so that more happens to each."""
        self.few = chance.sample(sorted(OPTIONS), chance.randint(1, 2))
        if "markers" in self.few:
            self.few.append("mesh")

    # Values -----------------------------------------------------------------------------------

    def array(self, shape):
        """An array of new numbers, of any type, in any form."""
        first = next(self.numbers)
        count = int(np.prod(shape))
        values = first + np.sin(np.arange(count) + first)
        form = first % 5
        if form == 0:
            return np.round(values).astype(int).reshape(shape)
        if form == 1:
            return values.astype(np.float32).reshape(shape)
        if form == 2:
            return np.repeat(values, 2)[::2].reshape(shape)
        values = values.reshape(shape)
        return values.tolist() if form == 4 and count else values

    def value(self, chance, kind, option, length, values):
        """A value of an option that is right by itself."""
        if option in RESETTABLE and chance.random() < 1 / 8:
            return None
        if option in SHAPES:
            if option in EMPTY_IS_NONE and chance.random() < 1 / 10:
                length = 0
            if kind == "height_field" and option == "scalar_field":
                return self.array((min(length, 2), length))
            return self.array([length if each == "n" else each for each in SHAPES[option]])
        if option in ("labels", "bodies"):
            return [f"{next(self.numbers)}" for _ in range(length)]
        if option in ("cells", "indices"):
            high = max(0, length - 1 if option == "cells" else 3)
            shape = (2, 3) if option == "cells" else (length,)
            size = int(np.prod(shape))
            cells = [chance.randint(0, high) for _ in range(size)]
            return np.array(cells, int).reshape(shape)
        if option in ("vmin", "vmax"):
            return float(chance.randint(0, 4))
        if option == "mesh":
            meshes = [name for name in self.kinds if self.kinds[name] == "mesh"]
            return chance.choice([*meshes * 4, "no mesh"])
        return chance.choice(WORDS[option][0])

    def wrong(self, chance, option, value):
        """A value of an option that is wrong by itself; None: there is none."""
        if option in SHAPES or option in ("cells", "indices"):
            array = np.array(value, float)
            forms = [array[np.newaxis], "text", [array, [1]], np.full(array.shape, "1"), 1j * array]
            if array.size:
                broken, place = array.copy(), chance.randint(0, array.size - 1)
                bad = -0.5 if option in ("cells", "indices") else 1e39
                bad = np.nan if option in ("values", "poses") else bad
                broken.flat[place] = chance.choice([np.nan, np.inf, bad])
                forms.append(broken)
            return forms[chance.randint(0, len(forms) - 1)]
        if option in ("labels", "bodies"):
            return chance.choice([7, "text", np.array("text")])
        if option in ("vmin", "vmax"):
            return chance.choice([np.nan, np.inf, "low"])
        known = WORDS.get(option, ([], []))[1]
        known = [each for each in known if each is not None or option not in RESETTABLE]
        return known[chance.randint(0, len(known) - 1)] if known else None

    def choose(self, chance, kind, name, options):
        """Values of some options, and whether all are right by themselves."""
        before = self.options.get(name, {})
        lengths = [len(before[o]) for o in ALIGNED & before.keys() if is_set(kind, o, before[o])]
        usual = max(lengths, default=4) if kind != "height_field" else 3
        length = chance.choice([usual, usual, usual, 0, 2, 3, 5])
        values, fits = {}, True
        for option in options:
            count = length if chance.random() > 1 / 20 else length + 1
            values[option] = self.value(chance, kind, option, count, values)
            if chance.random() < 1 / 30:
                wrong = self.wrong(chance, option, [] if values[option] is None else values[option])
                if wrong is not None:
                    values[option], fits = wrong, False
        return values, fits

    # What is right ----------------------------------------------------------------------------

    def problem(self, kind, name, after):
        """Whether options do not fit each other, or those of other objects."""
        lengths = {
            np.shape(value) if kind == "height_field" else len(value)
            for option, value in after.items()
            if option in ALIGNED and is_set(kind, option, value)
        }
        low, high = after.get("vmin"), after.get("vmax")
        if len(lengths) > 1 or (low is not None and high is not None and low >= high):
            return True
        if kind == "mesh":
            used = [after["cells"].ravel()]
            used += [m["indices"] for m in self.options.values() if m.get("mesh") == name]
            used = np.concatenate(used)
            return len(used) > 0 and not 0 <= used.min() <= used.max() < len(after["positions"])
        if kind == "markers":
            if self.kinds.get(after["mesh"]) != "mesh":
                return True
            count = len(self.options[after["mesh"]]["positions"])
            return len(after["indices"]) > 0 and not after["indices"].max() < count
        return False

    def after(self, name, changes):
        """All options of an object after changes."""
        before = dict(self.options.get(name, {}))
        if "color" in changes:
            before.pop("scalar_field", None)
        return {**before, **{o: None if v is None else plain(o, v) for o, v in changes.items()}}

    def note(self, action, name, kind, values):
        """Note what is to be seen; markers are symbols where their vertices are."""
        values = {o: None if v is None else plain(o, v) for o, v in values.items()}
        if kind == "markers":
            kind, mesh = "symbols", values.pop("mesh", None)
            if "indices" in values:
                mesh = self.options[mesh or self.options[name]["mesh"]]
                values |= self.places(mesh, values.pop("indices"))
        self.happened.setdefault(name, []).append((action, kind, values))

    def places(self, mesh, indices):
        normals = normals_of(mesh)[indices].astype(np.float32)
        return {"positions": mesh["positions"][indices], "orientations": normals}

    def set(self, name, changes):
        """Change an object of the model."""
        kind = self.kinds[name]
        self.options[name] = self.after(name, changes)
        self.note("update", name, kind, changes)
        if kind == "mesh" and changes.keys() & {"positions", "cells"}:
            for other, options in self.options.items():
                if options.get("mesh") == name:
                    places = self.places(self.options[name], options["indices"])
                    self.happened.setdefault(other, []).append(("update", "symbols", places))

    @contextlib.contextmanager
    def refused(self, *names):
        """A call is an error that names one of the objects."""
        with pytest.raises(ConfigError) as raised:
            yield
        assert any(f'"{name}"' in str(raised.value) for name in names), str(raised.value)

    def spoil(self, values):
        """Change arrays that were given: nothing of it may be seen."""
        for value in values.values():
            if isinstance(value, np.ndarray) and value.dtype.kind in "fi":
                value.fill(-77)

    # Calls ------------------------------------------------------------------------------------

    @rule(chance=CHANCE, name=st.sampled_from(NAMES))
    def add(self, chance, name):
        kind = chance.choice(self.few)
        some = [o for o in OPTIONS[kind] if o not in needed(kind) and chance.random() < 0.5]
        is_new = name not in self.kinds
        if not is_new:
            some = []
        values, fits = self.choose(chance, kind, "", [*needed(kind), *some])
        given = {option: value for option, value in values.items() if value is not None}
        fits = fits and is_new and not self.kinds_clash(given)
        if not fits or self.problem(kind, name, self.after("", given)):
            with self.refused(name):
                getattr(self.factory, f"add_{kind}")(name, **values)
            return
        expected = self.after("", given)
        self.note("add", name, kind, given)
        assert getattr(self.factory, f"add_{kind}")(name, **values) == name
        self.kinds[name], self.options[name] = kind, expected
        self.spoil(values)

    def kinds_clash(self, values):
        return "mesh" in values and self.kinds.get(values["mesh"]) != "mesh"

    @precondition(lambda self: self.kinds)
    @rule(chance=CHANCE, count=st.integers(1, 8))
    def update(self, chance, count):
        for _ in range(count):
            name = chance.choice(sorted(self.kinds))
            self.change(name, self.kinds[name], chance)

    def change(self, name, kind, chance):
        likely = chance.choice([0.2, 0.5, 0.9])
        options = [o for o in changeable(kind) if chance.random() < likely]
        options = ["values"] if kind == "scalars" else options
        values, fits = self.choose(chance, kind, name, options)
        call = getattr(self.factory, f"update_{kind}")
        if not fits or self.problem(kind, name, self.after(name, values)):
            with self.refused(name):
                call(name, **values)
            return
        self.set(name, values)
        call(name, **values)
        self.spoil(values)

    @precondition(lambda self: {"box", "sphere"} & set(self.kinds.values()))
    @rule(chance=CHANCE, count=st.integers(1, 6))
    def move(self, chance, count):
        rigid = sorted(name for name in self.kinds if "position" in OPTIONS[self.kinds[name]])
        for _ in range(count):
            name = chance.choice(rigid)
            options = chance.choice([POSE[:1], POSE[1:], POSE, POSE[::-1]])
            values, fits = self.choose(chance, self.kinds[name], name, options)
            call = getattr(self.factory, f"update_{self.kinds[name]}")
            if len(values) == 2 and chance.random() < 1 / 20:
                values, fits = dict(zip(values, reversed(values.values()), strict=True)), False
            if not fits:
                with self.refused(name):
                    call(name, **values)
                continue
            self.set(name, values)
            call(name, **values)
            self.spoil(values)

    @precondition(lambda self: self.kinds)
    @rule(chance=CHANCE)
    def update_many(self, chance):
        kind = chance.choice(sorted(set(self.kinds.values())))
        alike = sorted(name for name in self.kinds if self.kinds[name] == kind)
        names = chance.choices(alike, k=chance.randint(0, 4))
        options = [o for o in changeable(kind) if chance.random() < 0.5]
        if chance.random() < 0.5 and kind in ("box", "sphere", "height_field"):
            options = [o for o in options if o in POSE]
        each, right = [], True
        for name in names:
            values, fits = self.choose(chance, kind, name, options)
            each.append(values)
            right = right and fits
        values = {option: [row[option] for row in each] for option in options}
        for option in options:  # of arrays, where they can be one
            shapes = {np.shape(row[option]) for row in each if right}
            if right and (option in SHAPES or option in ("cells", "indices")):
                right = len(shapes) < 2 and all(row[option] is not None for row in each)
                if right and names:
                    values[option] = np.stack([np.asarray(v) for v in values[option]])
        if options and chance.random() < 1 / 10:
            values[options[0]] = values[options[0]][:-1] if names else [1]
            right = False
        if not names or not options:  # nothing changes, or the wrong count is an error
            with contextlib.suppress(ConfigError):
                self.factory.update_many(kind, names, values)
            return
        kept = self.happened, self.options
        self.happened = {name: list(log) for name, log in self.happened.items()}
        self.options = dict(self.options)
        for name, row in zip(names, each, strict=True):
            if not right or self.problem(kind, name, self.after(name, row)):
                self.happened, self.options = kept
                with self.refused(*names):
                    self.factory.update_many(kind, names, values)
                return
            self.set(name, row)
        self.factory.update_many(kind, names, values)
        self.spoil(values)

    @precondition(lambda self: len(self.kinds) > 2)
    @rule(chance=CHANCE)
    def remove(self, chance):
        known = sorted(self.kinds)
        names = chance.choices([*known * 2, "none"], k=chance.randint(1, 2))
        if "none" in names:
            with self.refused("none"):
                self.factory.remove(*names)
            return
        for name in names:
            marks = [n for n, options in self.options.items() if options.get("mesh") == name]
            for each in (*marks, name):
                if each in self.kinds:
                    self.note("remove", each, self.kinds.pop(each), {})
                    del self.options[each]
        self.factory.remove(*names)

    @rule()
    def set_again(self):
        """What is set fits still, one option after another, whatever was refused."""
        for name, options in self.options.items():
            for option, value in list(options.items()):
                if option in changeable(self.kinds[name]) and option != "color":
                    given = None if value is None else plain(option, value)
                    if given is not None or option in RESETTABLE:
                        self.set(name, {option: given})
                        getattr(self.factory, f"update_{self.kinds[name]}")(name, **{option: given})

    @precondition(lambda self: self.kinds)
    @rule(chance=CHANCE, name=st.sampled_from([*NAMES, "none"]))
    def wrong_names_kinds_and_options(self, chance, name):
        kind = chance.choice(sorted(OPTIONS))
        known = chance.choice(sorted(self.kinds))
        if self.kinds[known] != "scalars":
            with self.refused(known):
                getattr(self.factory, f"update_{self.kinds[known]}")(known, colour="red")
        with self.refused("view"):
            self.factory.update_many("view", ["view"], {"title": ["other"]})
        with self.refused("boxes"):
            self.factory.update_many("boxes", [known], {})
        if self.kinds.get(name) != kind:
            with self.refused(name):
                self.factory.update_many(kind, [name], {})
            if kind != "scalars":
                with self.refused(name):
                    getattr(self.factory, f"update_{kind}")(name, color="red")

    @rule(seconds=st.sampled_from([0.0, 1, np.float32(2.5), np.nan, np.inf, "now", None]))
    def set_time(self, seconds):
        if isinstance(seconds, (int, float, np.floating)) and np.isfinite(seconds):
            self.happened.setdefault("time", []).append(("update", "time", {"seconds": seconds}))
            self.factory.set_time(seconds)
        else:
            with pytest.raises(ConfigError, match="time"):
                self.factory.set_time(seconds)

    # What is seen -----------------------------------------------------------------------------

    @rule()
    def take(self):
        for event in self.factory.take_events():
            for one in event.each():
                self.seen.setdefault(one.name, []).append((one.action, one.kind, dict(one.values)))
                self.show(one)
        assert self.factory.take_events() == []
        seen, happened = self.told(self.seen), self.told(self.happened)
        for name in {**seen, **happened}:
            assert seen.get(name) == happened.get(name), (name, seen.get(name), happened.get(name))
        self.seen, self.happened = {}, {}
        assert self.shown.keys() == self.kinds.keys()
        for name, (kind, values) in self.shown.items():
            own = {o: v for o, v in self.options[name].items() if o not in ("mesh", "indices")}
            if self.kinds[name] == "markers":
                mesh = self.options[self.options[name]["mesh"]]
                own |= self.places(mesh, self.options[name]["indices"])
                assert kind == "symbols"
            else:
                assert kind == self.kinds[name]
            own.pop("package_dirs", None)
            assert normal(values) == normal(own)

    def show(self, event):
        """What a viewer does with an event."""
        if event.kind == "time":
            return
        if event.action == "add":
            assert event.name not in self.shown
            self.shown[event.name] = event.kind, {}
        kind, values = self.shown[event.name]
        assert kind == event.kind
        if event.action == "remove":
            del self.shown[event.name]
        if "color" in event.values:
            values.pop("scalar_field", None)
        values |= {o: v for o, v in event.values.items() if o != "package_dirs"}

    def told(self, logs):
        return {
            name: [
                (action, kind, normal({o: v for o, v in values.items() if o != "package_dirs"}))
                for action, kind, values in log
            ]
            for name, log in logs.items()
        }

    def teardown(self):
        self.take()


@pytest.mark.parametrize("number", range(2))
def test_a_viewer_sees_what_was_set(number):
    run_state_machine_as_test(seed(number)(Machine), settings=QUICK)


@pytest.mark.faults
@pytest.mark.parametrize("number", range(100, 104))
def test_longer_histories(number):
    run_state_machine_as_test(seed(number)(Machine), settings=LONG)
