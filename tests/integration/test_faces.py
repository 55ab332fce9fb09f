"""The public packages have the names that they announce."""

from __future__ import annotations

import importlib

import pytest

CORE = ["", ".cli", ".components", ".net", ".pipelines", ".plugins", ".sources", ".workers"]
OTHERS = ["physx_sim", "physx_sim.engines", "physx_testing", "physx_formats"]
LAZY = [*(f"physx_core{name}" for name in CORE), *OTHERS]
FACES = [*LAZY, *(f"physx_core.{name}" for name in ("config", "dataset", "errors", "typing"))]


@pytest.mark.parametrize("name", FACES)
def test_a_face_has_its_names_and_says_what_it_is_for(name):
    face = importlib.import_module(name)
    assert len((face.__doc__ or "").strip()) > 20
    names = {}
    exec(f"from {name} import *", names)  # noqa: S102
    public = getattr(face, "__all__", [])
    assert len(set(public)) == len(public)
    for entry in public:
        assert names[entry] is getattr(face, entry)
        assert entry in dir(face)


@pytest.mark.parametrize("name", LAZY)
def test_a_lazy_face_offers_nothing_else(name):
    face = importlib.import_module(name)
    assert set(dir(face)) == set(face.__all__)
    with pytest.raises(AttributeError):
        face.nothing  # noqa: B018
