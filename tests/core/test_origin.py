"""Hints to install name the place that physx itself was installed from."""

from __future__ import annotations

import json
import os
import subprocess
import sys

import pytest

pytestmark = pytest.mark.processes

HINT = "import sys; from physx_core.origin import install_hint; print(install_hint(*sys.argv[1:]))"
REPOSITORY = "https://example.org/physx.git"


@pytest.fixture
def hint(tmp_path):
    """Return a function: the hint for a package if the core was installed in a given way."""

    def hint(where, *arguments):
        info = tmp_path / "site" / "physx_core-9.dist-info"
        info.mkdir(parents=True)
        (info / "METADATA").write_text("Metadata-Version: 2.1\nName: physx-core\nVersion: 9\n")
        if where is not None:
            text = where if isinstance(where, str) else json.dumps(where)
            (info / "direct_url.json").write_text(text)
        path = f"{info.parent}:{os.environ.get('PYTHONPATH', '')}"
        done = subprocess.run(
            [sys.executable, "-c", HINT, *arguments],
            env={**os.environ, "PYTHONPATH": path},
            capture_output=True,
            text=True,
            check=True,
        )
        return done.stdout.strip()

    return hint


def folder(tmp_path, *names):
    for name in names:
        (tmp_path / "sources" / name).mkdir(parents=True)
        (tmp_path / "sources" / name / "pyproject.toml").touch()
    return tmp_path / "sources"


@pytest.mark.parametrize("editable", [False, True])
def test_from_a_folder(hint, tmp_path, editable):
    place = folder(tmp_path, "physx_core", "physx_torch")
    where = {"url": f"file://{place}/physx_core", "dir_info": {"editable": editable}}
    flag = "-e " if editable else ""
    assert hint(where, "physx-torch") == f"To install it: pip install {flag}{place}/physx_torch"


def test_an_extra_of_the_core_itself_in_a_folder_with_a_space(hint, tmp_path):
    place = folder(tmp_path / "my sources", "physx_core")
    where = {"url": place.as_uri() + "/physx_core", "dir_info": {}}
    expected = f'To install it: pip install "{place}/physx_core[zarr]"'
    assert hint(where, "physx-core", "zarr") == expected


def test_from_a_folder_without_the_package(hint, tmp_path):
    place = folder(tmp_path, "physx_core")
    where = {"url": f"file://{place}/physx_core", "dir_info": {}}
    assert hint(where, "physx-torch") == f"Install physx-torch from file://{place}/physx_core"


def test_from_a_repository_without_its_password(hint):
    where = {
        "url": REPOSITORY.replace("//", "//user:secret@"),
        "vcs_info": {"vcs": "git", "requested_revision": "v2", "commit_id": "0123abc"},
        "subdirectory": "packages/physx_core",
    }
    expected = f"physx-torch[export] @ git+{REPOSITORY}@v2#subdirectory=packages/physx_torch"
    assert hint(where, "physx-torch", "export") == f'To install it: pip install "{expected}"'


def test_from_an_archive_of_the_repository(hint):
    where = {"url": "https://example.org/1.zip", "archive_info": {}, "subdirectory": "physx_core"}
    expected = 'pip install "physx-gym @ https://example.org/1.zip#subdirectory=physx_gym"'
    assert hint(where, "physx-gym") == f"To install it: {expected}"


def test_from_a_folder_of_wheels(hint, tmp_path):
    (tmp_path / "physx_gym-9-py3-none-any.whl").touch()
    where = {"url": f"file://{tmp_path}/physx_core-9-py3-none-any.whl", "archive_info": {}}
    wheel = tmp_path / "physx_gym-9-py3-none-any.whl"
    assert hint(where, "physx-gym") == f"To install it: pip install {wheel}"


def test_from_a_folder_of_wheels_without_the_package(hint, tmp_path):
    where = {"url": f"file://{tmp_path}/physx_core-9-py3-none-any.whl", "archive_info": {}}
    assert hint(where, "physx-gym") == f"Install physx-gym from {where['url']}"


def test_from_an_index(hint):
    assert hint(None, "physx-gym", "plot") == 'To install it: pip install "physx-gym[plot]"'


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"url": 5}', '{"url": "x", "vcs_info": 3}'])
def test_from_a_place_that_cannot_be_read(hint, text):
    assert hint(text, "physx-gym").startswith("Install physx-gym from ")
