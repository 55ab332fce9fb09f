"""Generators of the gest-api standard choose parameters: they suggest, and ingest losses."""

from __future__ import annotations

import sys
import types

import numpy as np
import pytest

from physx_core import Parameter
from physx_core.errors import ConfigError, MissingLibraryError
from physx_core.plugins import resolve

PARAMETERS = [
    Parameter("k", 10.0, 40.0),
    Parameter("push", -1.0, 1.0, shape=(2,)),
    Parameter("n", 1, 4, distribution="integer"),
]


class Nearby:
    """Suggests points near the one with the highest loss that it knows."""

    def __init__(self, vocs, seed=0, short=False):
        self.vocs, self.random, self.short = vocs, np.random.default_rng(seed), short
        self.known = []
        self.made = 0

    def suggest(self, number):
        points = []
        for _ in range(number - self.short):
            point = {"_id": self.made}
            self.made += 1
            for name, (low, high) in self.vocs.variables.items():
                center = max(self.known, key=lambda one: one["loss"])[name] if self.known else low
                value = center + 0.1 * (high - low) * self.random.standard_normal()
                point[name] = float(np.clip(value, low, high))
            points.append(point)
        return points

    def ingest(self, results):
        assert all({*self.vocs.variables, "loss", "_id"} == one.keys() for one in results)
        self.known += results


@pytest.fixture
def begun(monkeypatch):
    """Return a function that makes the sampler; the standard's descriptions are simple ones."""
    module = types.ModuleType("gest_api.vocs")
    module.VOCS = types.SimpleNamespace
    monkeypatch.setitem(sys.modules, "gest_api", types.ModuleType("gest_api"))
    monkeypatch.setitem(sys.modules, "gest_api.vocs", module)

    def make(parameters=PARAMETERS, **options):
        sampler = resolve("sampler", "physx/generator")(**{"generator": Nearby, **options})
        sampler.begin(parameters, [1])
        return sampler

    return make


def test_a_generator_suggests_ingests_and_gets_what_it_asks_for(begun):
    sampler = begun(points=8)
    chosen = [sampler.ask(number) for number in range(8)]
    assert all(one.contains(values[one.name]) for values in chosen for one in PARAMETERS)
    assert np.shape(chosen[0]["push"]) == (2,)
    for batch in range(29):
        losses = np.array([values["k"] for values in chosen])
        sampler.tell(np.arange(8) + 8 * batch, chosen, losses)
        chosen = [sampler.ask(number + 8 * batch + 8) for number in range(8)]
    assert np.mean([values["k"] for values in chosen]) > 35  # it climbs


def test_a_generator_suggests_anew_when_all_is_asked_for_and_when_it_is_told(begun):
    sampler = begun(points=4)
    chosen = [sampler.ask(number) for number in range(6)]
    assert sampler._generator.made == 8
    sampler.tell(np.arange(4), chosen[:4], np.arange(4.0))
    assert [one["loss"] for one in sampler._generator.known] == [0.0, 1.0, 2.0, 3.0]
    sampler.ask(6)
    assert sampler._generator.made == 12


def test_what_does_not_fit_is_an_error(begun, monkeypatch):
    with pytest.raises(ConfigError, match='"a" has none'):
        begun([Parameter("a", mean=0.0, deviation=1.0, distribution="normal")])
    with pytest.raises(ConfigError, match=r"suggest\(32\) returned 31"):
        begun(generator_kwargs={"short": True})
    with pytest.raises(ConfigError, match="points is 0"):
        begun(points=0)
    monkeypatch.setitem(sys.modules, "gest_api.vocs", None)
    with pytest.raises(MissingLibraryError, match="gest-api"):
        begun()
