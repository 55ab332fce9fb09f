"""Findings: what a command keeps comes back equal, from either kind of file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import pytest

from physx_core.errors import SessionError
from physx_core.results import read_finding, read_results, store_finding, write_finding


@dataclass(frozen=True)
class Part:
    name: str
    error: float | None = None


@dataclass(frozen=True)
class Found:
    parts: Sequence[Part]
    factors: Mapping[str, float]

    def __str__(self) -> str:
        return f"{len(self.parts)} parts\nof them"


FOUND = Found((Part("a", 0.1), Part("b")), {"x": 1e-300})


@pytest.mark.parametrize("name", ["count.toml", "count.json", "count"])
def test_a_finding_comes_back_equal_and_is_a_result(tmp_path, name):
    store_finding(tmp_path / "session", name, FOUND, 2.5)
    store_finding(tmp_path / "session", name, FOUND, 3.5)
    assert read_finding(Found, tmp_path / "session" / name) == FOUND
    [result] = read_results(tmp_path / "session").values()
    assert (result.kind, result.seconds) == ("count", 3.5)
    assert list(result.summary) == ["2 parts", "of them"]


def test_what_is_no_finding_is_an_error(tmp_path):
    write_finding(tmp_path / "a.json", FOUND.parts[0])
    for path in (tmp_path / "a.json", tmp_path / "none.toml", tmp_path):
        with pytest.raises(ValueError):
            read_finding(Found, path)
    with pytest.raises(SessionError, match="cannot be written"):
        store_finding(tmp_path / "a.json", "count.toml", FOUND)
