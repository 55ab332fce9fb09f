"""Files of The Well, PDEBench and robomimic become rows by trajectory and step."""

import h5py
import numpy as np
import pytest

from physx_core import Dataset, View
from physx_formats import ExchangeError, import_file

RNG = np.random.default_rng(0)
COUNT, STEPS, X, Y = 3, 5, 4, 6


def put(group, name, values, **attributes):
    group[name] = np.asarray(values)
    group[name].attrs.update(attributes)
    return group[name][()]


def rows_of(path):
    """Return the modes of an imported file, their rows by field, and the info."""
    with Dataset.open(path) as dataset:
        fields = {mode: dataset.fields(mode) for mode in dataset.modes}
        rows = {m: {n: dataset[m][n][:] for n in each} for m, each in fields.items()}
        return fields, rows, dataset.info


@pytest.fixture
def well(tmp_path):
    path, kept = tmp_path / "turbulence.hdf5", {}
    with h5py.File(path, "w") as file:
        file.attrs.update(n_trajectories=COUNT, n_spatial_dims=2, grid_type="cartesian")
        dimensions = file.create_group("dimensions")
        dimensions.attrs["spatial_dims"] = ["x", "y"]
        kept["time"] = put(dimensions, "time", np.arange(STEPS) / 10, sample_varying=False)
        kept["x"] = put(dimensions, "x", np.arange(X), time_varying=False)
        put(dimensions, "y", np.arange(Y), time_varying=False)
        of = {
            ("t0_fields", "density"): ((COUNT, STEPS, X, Y), True, True),
            ("t0_fields", "mask"): ((X, Y), False, False),
            ("t0_fields", "wall"): ((COUNT, X, Y), True, False),
            ("t0_fields", "forcing"): ((STEPS, X, Y), False, True),
            ("t1_fields", "velocity"): ((COUNT, STEPS, X, Y, 2), True, True),
            ("t2_fields", "stress"): ((COUNT, STEPS, X, Y, 2, 2), True, True),
            ("scalars", "reynolds"): ((COUNT,), True, False),
            ("scalars", "power"): ((COUNT, STEPS), True, True),
            ("scalars", "gamma"): ((), False, False),
        }
        for (group, name), (shape, by_sample, by_time) in of.items():
            values = RNG.normal(size=shape).astype(np.float32)
            flags = {"sample_varying": by_sample, "time_varying": by_time}
            kept[name] = put(file.require_group(group), name, values, **flags)
    return path, kept


def test_the_well(well, tmp_path):
    path, kept = well
    assert import_file(path, tmp_path / "set") == {"training": COUNT * STEPS}
    fields, rows, info = rows_of(tmp_path / "set")
    fields, rows = fields["training"], rows["training"]
    for row in range(COUNT * STEPS):
        k, t = divmod(row, STEPS)
        assert (rows["episode"][row], rows["step"][row]) == (k, t)
        assert rows["time"][row] == kept["time"][t]
        for name, place in {
            "density": (k, t), "velocity": (k, t), "stress": (k, t), "power": (k, t),
            "wall": (k,), "reynolds": (k,), "forcing": (t,), "mask": (),
        }.items():  # fmt: skip
            np.testing.assert_array_equal(rows[name][row], kept[name][place])
    assert fields["density"].axes == ("x", "y")
    assert fields["velocity"].axes == ("x", "y", "channel")
    assert fields["stress"].axes == ("x", "y", "channel", "component")
    assert {n for n, f in fields.items() if f.role == "training"} == {
        "density", "velocity", "stress", "forcing"
    }  # fmt: skip
    assert info["layout"] == "The Well" and info["coordinates"]["x"] == kept["x"].tolist()
    assert info["parameters"] == {"gamma": pytest.approx(kept["gamma"].item())}
    window = {"past": ("density", [-1, 0]), "next": ("density", 1)}
    batches = View(window=window, hold_back=False).open(4, seed=0, data=tmp_path / "set")
    assert batches.num_items == COUNT * (STEPS - 2)  # never across trajectories


def test_pdebench_with_all_trajectories_in_one_array(tmp_path):
    with h5py.File(tmp_path / "burgers.h5", "w") as file:
        u = put(file, "tensor", RNG.normal(size=(COUNT, STEPS, X)))
        t = put(file, "t-coordinate", np.arange(STEPS + 1) * 0.05)  # these files have one more
        x = put(file, "x-coordinate", np.linspace(0, 1, X))
    import_file(tmp_path / "burgers.h5", tmp_path / "set")
    fields, rows, info = rows_of(tmp_path / "set")
    rows = rows["training"]
    np.testing.assert_array_equal(rows["tensor"], u.reshape(-1, X))
    np.testing.assert_array_equal(rows["time"], np.tile(t[:-1], COUNT))
    assert rows["episode"].tolist() == np.repeat(range(COUNT), STEPS).tolist()
    assert fields["training"]["tensor"].axes == ("x",)
    assert info["layout"] == "PDEBench" and info["coordinates"] == {"x": x.tolist()}


def test_pdebench_with_several_fields_and_a_coefficient(tmp_path):
    with h5py.File(tmp_path / "flow.h5", "w") as file:
        shape = (COUNT, STEPS, X, Y)
        flow = {name: put(file, name, RNG.normal(size=shape)) for name in ("Vx", "pressure")}
        nu = put(file, "nu", RNG.normal(size=(COUNT, X, Y)))
        for name, size in (("x", X), ("y", Y), ("t", STEPS)):
            put(file, f"{name}-coordinate", np.arange(size))
    import_file(tmp_path / "flow.h5", tmp_path / "set")
    _, rows, _ = rows_of(tmp_path / "set")
    for name, values in flow.items():
        np.testing.assert_array_equal(rows["training"][name], values.reshape(-1, X, Y))
    np.testing.assert_array_equal(rows["training"]["nu"], np.repeat(nu, STEPS, axis=0))


def test_pdebench_with_a_group_for_each_trajectory(tmp_path):
    with h5py.File(tmp_path / "reaction.h5", "w") as file:
        data = []
        for number in range(COUNT):
            group = file.create_group(f"{number:04}")
            data.append(put(group, "data", RNG.normal(size=(STEPS, X, Y, 2))))
            for name, size in (("x", X), ("y", Y), ("t", STEPS)):
                put(group, f"grid/{name}", np.arange(size) * 0.5)
    import_file(tmp_path / "reaction.h5", tmp_path / "set")
    fields, rows, info = rows_of(tmp_path / "set")
    np.testing.assert_array_equal(rows["training"]["data"], np.concatenate(data))
    assert rows["training"]["time"].tolist() == [0.5 * t for t in range(STEPS)] * COUNT
    assert fields["training"]["data"].axes == ("x", "y", "channel")
    assert info["coordinates"]["y"] == [0.5 * k for k in range(Y)]


def test_robomimic_with_its_own_validation_part(tmp_path):
    with h5py.File(tmp_path / "lift.hdf5", "w") as file:
        demos, kept = file.create_group("data"), {}
        demos.attrs["env_args"] = '{"env_name": "Lift"}'
        for number in range(12):  # demo_10 is after demo_9
            group, steps = demos.create_group(f"demo_{number}"), 3 + number % 4
            kept[number] = put(group, "actions", RNG.normal(size=(steps, 7)))
            put(group, "obs/eef", RNG.normal(size=(steps, 3)))
            put(group, "rewards", np.arange(steps) == steps - 1)
            group.attrs["num_samples"] = steps
        file["mask/train"] = [b"demo_%d" % k for k in range(12) if k not in (2, 10)]
        file["mask/valid"] = [b"demo_2", b"demo_10"]
    training = [k for k in range(12) if k not in (2, 10)]
    done = import_file(tmp_path / "lift.hdf5", tmp_path / "set")
    assert done == {
        "training": sum(len(kept[k]) for k in training), "validation": len(kept[2]) + len(kept[10])
    }  # fmt: skip
    fields, rows, info = rows_of(tmp_path / "set")
    np.testing.assert_array_equal(
        rows["training"]["actions"], np.concatenate([kept[k] for k in training])
    )
    np.testing.assert_array_equal(
        rows["validation"]["actions"], np.concatenate([kept[2], kept[10]])
    )
    assert rows["training"]["episode"].max() == 9 and "obs_eef" in fields["training"]
    assert info["parameters"]["env_args"] == '{"env_name": "Lift"}'


def test_a_layout_that_contradicts_itself_is_refused(well, tmp_path):
    path, _ = well
    for count, reason in ((COUNT + 1, "has the shape"), (10**12, "claims that it has")):
        with h5py.File(path, "a") as file:
            file.attrs["n_trajectories"] = count
        with pytest.raises(ExchangeError, match=reason):
            import_file(path, tmp_path / "set")
    assert not (tmp_path / "set").exists()


def test_other_files_are_no_such_layout(tmp_path):
    with h5py.File(tmp_path / "plain.h5", "w") as file:
        put(file, "data", np.zeros((4, 2)))
        put(file, "x-coordinate", np.zeros(4))
    import_file(tmp_path / "plain.h5", tmp_path / "set")
    fields, _, info = rows_of(tmp_path / "set")
    assert set(fields["training"]) == {"data", "x_coordinate"} and "layout" not in info
