import os
import shutil
import zipfile

import h5py
import numpy as np
import pytest
from numpy.testing import assert_array_equal
from sizes import size

from physx_core import Dataset
from physx_core.errors import DatasetError, FieldsMismatchError, NotFiniteError
from physx_formats import ExchangeError, export, import_file

X = np.random.default_rng(0).normal(size=(10, 3))


def test_arrays_become_fields(folder, tmp_path):
    np.savez_compressed(tmp_path / "a.npz", x=X, flag=X[:, 0] > 0, step=np.arange(10))
    assert import_file(tmp_path / "a.npz", folder) == {"training": 10}
    with Dataset.open(folder) as dataset:
        assert_array_equal(dataset["training"]["x"][:], X)
        assert dataset["training"]["flag"].dtype == bool
        assert dataset.fields("training")["step"].role == "additional"


def test_other_layouts_and_byte_orders_are_read(folder, tmp_path):
    np.savez(tmp_path / "a.npz", f=np.asfortranarray(X), big=X.astype(">f4"), none=X[:, :0])
    import_file(tmp_path / "a.npz", folder)
    with Dataset.open(folder) as dataset:
        assert_array_equal(dataset["training"]["f"][:], X)
        assert_array_equal(dataset["training"]["big"][:], X.astype("f4"))
        assert dataset["training"]["none"].shape == (10, 0)


def test_groups_become_names_or_modes(folder, tmp_path):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["obs/joint angle"] = X
        file["obs/joint angle"].attrs["units"] = "rad"
        file["3d"] = X
    with h5py.File(tmp_path / "b.hdf5", "w") as file:
        file["training/x"], file["validation/x"] = X, X[:4]
    import_file(tmp_path / "a.h5", folder, mode="prediction")
    import_file(tmp_path / "b.hdf5", tmp_path / "b")
    with Dataset.open(folder) as dataset:
        assert dataset.modes == ["prediction"]
        assert set(dataset["prediction"]) == {"_3d", "obs_joint_angle"}
        assert dataset.fields("prediction")["obs_joint_angle"].unit == "rad"
    with Dataset.open(tmp_path / "b") as dataset:
        assert {mode: dataset.num_samples(mode) for mode in dataset.modes} == {
            "training": 10,
            "validation": 4,
        }


def test_the_index_of_a_dataset_leads_to_other_files(folder, tmp_path):
    with Dataset.create(folder, max_file_size=1.7e-5) as dataset:
        dataset.append("training", {"x": np.arange(500.0)})
    for place in (folder / "run.h5", folder):
        with pytest.raises(ExchangeError, match=r"Dataset\.merge"):
            import_file(place, tmp_path / "back")
    with Dataset.create(tmp_path / "back") as back:
        back.merge(folder)
        assert_array_equal(back["training"]["x"][:], np.arange(500.0))


def test_rows_are_added_to_an_existing_dataset(folder, tmp_path):
    np.savez(tmp_path / "a.npz", x=X)
    np.savez(tmp_path / "b.npz", y=X)
    import_file(tmp_path / "a.npz", folder)
    import_file(tmp_path / "a.npz", folder)
    with pytest.raises(FieldsMismatchError):
        import_file(tmp_path / "b.npz", folder)
    with Dataset.open(folder) as dataset:
        assert_array_equal(dataset["training"]["x"][:], np.concatenate([X, X]))
        assert dataset.info == {"imported_from": "a.npz"}


def test_some_arrays_can_be_chosen(folder, tmp_path):
    np.savez(tmp_path / "a.npz", x=X, names=np.array(["a"] * 10), few=X[:3], one=1.0)
    for message in ("<U1", "different numbers", "no rows"):
        chosen = {"<U1": (), "different numbers": ("x", "few"), "no rows": ("one",)}[message]
        with pytest.raises(ExchangeError, match=message):
            import_file(tmp_path / "a.npz", folder, fields=chosen)
    with pytest.raises(ExchangeError, match='no array "y".*few, names, one, x'):
        import_file(tmp_path / "a.npz", folder, fields=["y"])
    assert not folder.exists()
    import_file(tmp_path / "a.npz", folder, fields=["x"])


def test_a_value_that_is_not_finite_leaves_no_dataset(folder, tmp_path):
    bad = X.copy()
    bad[7] = np.nan
    np.savez(tmp_path / "a.npz", x=bad)
    for there in (False, True):
        with pytest.raises(NotFiniteError, match='"x"') as caught:
            import_file(tmp_path / "a.npz", folder)
        assert "rows 0 to 9" in caught.value.__notes__[0]
        assert folder.exists() is there
        folder.mkdir(exist_ok=True)
    assert list(folder.iterdir()) == []


def test_a_folder_of_other_things_is_left_alone(folder, tmp_path):
    np.savez(tmp_path / "a.npz", x=X)
    folder.mkdir()
    (folder / "thesis.txt").write_text("all my work")
    with pytest.raises(ExchangeError, match="not empty"):
        import_file(tmp_path / "a.npz", folder)
    assert [path.name for path in folder.iterdir()] == ["thesis.txt"]


def test_files_that_cannot_be_imported(folder, tmp_path):
    (tmp_path / "empty").touch()
    (tmp_path / "a.txt").write_text("x, y\n1, 2\n")
    (tmp_path / "a.npz").write_bytes(b"PK but no zip")
    (tmp_path / "a.h5").write_bytes(b"\x89HDF\r\n\x1a\n and no more")
    np.savez(tmp_path / "none.npz")
    for name, message in {
        "empty": "is of no known format",
        "a.txt": "is of no known format",
        "b.npz": "There is no file",
        "a.npz": "not a valid npz",
        "a.h5": "as HDF5",
        "none.npz": "no arrays",
    }.items():
        with pytest.raises(ExchangeError, match=message):
            import_file(tmp_path / name, folder)
    assert not folder.exists()


# From strangers ---------------------------------------------------------------------------------


class Bomb:
    def __reduce__(self):
        return os.mkdir, ("exploded",)


def test_nothing_is_unpickled(folder, tmp_path):
    np.savez(tmp_path / "a.npz", x=np.array([Bomb()] * 3, object))
    with pytest.raises(ExchangeError, match="object"):
        import_file(tmp_path / "a.npz", folder)
    assert not (tmp_path / "exploded").exists()


@pytest.mark.parametrize("compress", [False, True])
@pytest.mark.parametrize("share", [0.1, 0.5, 0.9, 0.999])
def test_a_truncated_archive_is_an_error(folder, tmp_path, compress, share):
    path = tmp_path / "a.npz"
    (np.savez_compressed if compress else np.savez)(
        path, x=np.random.default_rng(0).normal(size=(999, 9))
    )
    content = path.read_bytes()
    path.write_bytes(content[: int(share * len(content))])
    with pytest.raises(ExchangeError):
        import_file(path, folder)
    assert not folder.exists()


def test_a_changed_byte_never_becomes_another_number(folder, tmp_path):
    path, x = tmp_path / "a.npz", np.random.default_rng(0).normal(size=(999, 9))
    np.savez(path, x=x)
    content = path.read_bytes()
    rejected, header = 0, range(0, 300, size(7, 30))
    places = [*header, *range(300, len(content), size(5009, 30_011)), len(content) - 30]
    for place in places:
        path.write_bytes(content[:place] + bytes([content[place] ^ 0x40]) + content[place + 1 :])
        try:
            import_file(path, folder)
        except ExchangeError:
            rejected += 1
            continue
        with Dataset.open(folder) as dataset:
            assert_array_equal(next(iter(dataset["training"].items()))[1][:], x)
        shutil.rmtree(folder)
    assert rejected > len(places) / 2


@pytest.mark.parametrize(
    "shape", ["(999999999999, 3)", "(-1, 3)", "(10, 999999999999)", "(10, -3)"]
)
def test_a_header_that_promises_too_much_is_an_error(folder, tmp_path, shape):
    header = f"{{'descr': '<f8', 'fortran_order': False, 'shape': {shape}, }}".ljust(117) + "\n"
    content = b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header.encode()
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as archive:
        archive.writestr("x.npy", content + bytes(240))
    with pytest.raises(ExchangeError, match="not as long"):
        import_file(tmp_path / "a.npz", folder)


def test_untrusted_notes_do_no_harm(folder, tmp_path):
    np.savez(tmp_path / "a.npz", x=X)
    for comment in (b'{"format": "physx export", "modes": {"../up": 3}}', b"\xff\xfe", b"[1]"):
        with zipfile.ZipFile(tmp_path / "a.npz", "a") as archive:
            archive.comment = comment
        assert import_file(tmp_path / "a.npz", folder) == {"training": 10}
    with zipfile.ZipFile(tmp_path / "a.npz", "a") as archive:
        archive.comment = b'{"format": "physx export", "modes": {"../up": []}}'
    with pytest.raises(DatasetError.__base__, match="identifier"):
        import_file(tmp_path / "a.npz", folder)


def test_links_out_of_an_hdf5_file_are_not_followed(folder, tmp_path):
    secret = tmp_path / "secret.bin"
    secret.write_bytes(bytes(80))
    with h5py.File(tmp_path / "other.h5", "w") as file:
        file["x"] = X

    def external(file):
        file["x"] = h5py.ExternalLink("other.h5", "/x")

    def soft(file):
        file["y"], file["x"] = X, h5py.SoftLink("/y")

    def raw(file):
        file.create_dataset("x", (10,), "f8", external=[(str(secret), 0, 80)])

    def virtual(file):
        layout = h5py.VirtualLayout((10, 3), "f8")
        layout[:] = h5py.VirtualSource(str(tmp_path / "other.h5"), "x", (10, 3))
        file.create_virtual_dataset("x", layout)

    def beside(file):
        layout = h5py.VirtualLayout((10, 3), "f8")
        layout[:] = h5py.VirtualSource("other.h5", "x", (10, 3))
        file.create_virtual_dataset("x", layout)

    def loop(file):
        file.create_group("a")
        file["a/b"] = file["a"]

    for number, make in enumerate((external, soft, raw, virtual, beside, loop)):
        with h5py.File(tmp_path / f"{number}.h5", "w") as file:
            make(file)
        with pytest.raises(ExchangeError, match="link|other files|contains itself"):
            import_file(tmp_path / f"{number}.h5", folder)
    assert not folder.exists()


# Sizes ------------------------------------------------------------------------------------------


def write_archive_that_says(path, nbytes):
    """An archive whose list of contents says that its only array has this size."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        header = f"{{'descr': '<f8', 'fortran_order': False, 'shape': ({nbytes // 8},), }}"
        content = (header.ljust(117) + "\n").encode()
        content = b"\x93NUMPY\x01\x00" + len(content).to_bytes(2, "little") + content
        archive.writestr("x.npy", content + bytes(2**20))
        archive.infolist()[0].file_size = nbytes + len(content)


@pytest.mark.slow
def test_what_unpacks_to_far_more_than_the_file_is_refused(folder, tmp_path):
    write_archive_that_says(tmp_path / "a.npz", 5 * 10**9)
    with h5py.File(tmp_path / "b.h5", "w") as file:
        file.create_dataset("x", (10**10,), "f8", chunks=(10**6,))
    with h5py.File(tmp_path / "c.h5", "w") as file:
        file.create_dataset("x", (10**15, 0), "f8")
    with h5py.File(tmp_path / "d.h5", "w") as file:
        file.create_dataset("x", (10**8,), "f8", chunks=(10**8,), compression="gzip")
    with h5py.File(tmp_path / "e.h5", "w") as file:
        group = file
        for _ in range(40):
            inner = group.create_group("a")
            group["b"], group = inner, inner
        group["x"] = X
    for name, message in {
        "a.npz": "holds 5 GB.*--max-bytes 5000000",
        "b.h5": "holds 80 GB.*--max-bytes 80000000000",
        "c.h5": "--max-bytes",
        "d.h5": "chunks of 800000000 bytes",
        "e.h5": "more than 10000 datasets",
    }.items():
        with pytest.raises(ExchangeError, match=message):
            import_file(tmp_path / name, folder)
    assert not folder.exists()


@pytest.mark.slow
def test_the_user_may_allow_more(folder, tmp_path):
    rows = 34 * 10**6  # of 1 byte each, which count as 8, because a row costs more than its bytes
    np.savez_compressed(tmp_path / "a.npz", x=np.zeros(rows, "u1"))
    with pytest.raises(ExchangeError, match="max_bytes=272000000"):
        import_file(tmp_path / "a.npz", folder)
    assert import_file(tmp_path / "a.npz", folder, max_bytes=272000000) == {"training": rows}
    with pytest.raises(ExchangeError, match="max_bytes"):
        import_file(tmp_path / "a.npz", folder, max_bytes=1000)


@pytest.mark.parametrize("form", ["npz", "hdf5-single"])
def test_a_file_is_recognized_by_its_content_not_its_name(folder, tmp_path, form):
    with Dataset.create(folder) as dataset:
        dataset.append("training", {"x": X})
        export(dataset, form, tmp_path / "rows")
    assert import_file(tmp_path / "rows", tmp_path / "b") == {"training": 10}
