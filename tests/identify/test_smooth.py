"""Smoothing of positions: exact, and as much as the noise asks for, wherever a log begins."""

import logged_oscillator as oscillator
import numpy as np
import pytest
from logged_arm import PERIOD, noisy

from physx_identify import identify
from physx_identify.estimation.smooth import Smoother, white_noise


def accelerations(positions):
    return np.diff(positions, 2, axis=0) / PERIOD**2


def test_smoothing_is_that_of_penalized_third_differences():
    positions = np.random.default_rng(0).normal(size=(60, 3)).cumsum(axis=0)
    smoother, rough = Smoother(positions), np.diff(np.eye(60), 3, axis=0)
    found = smoother(positions)
    for own, smooth in zip(positions.T, found.T, strict=True):
        bent = rough @ smooth
        strength = np.linalg.lstsq((rough.T @ bent)[:, None], own - smooth, rcond=None)[0]
        assert smooth + strength * (rough.T @ bent) == pytest.approx(own, abs=1e-9)
    parabola = np.linspace(0, 1, 60)[:, None] ** 2 * [1, -2, 3] + 1
    assert smoother(parabola) == pytest.approx(parabola, abs=1e-9)


@pytest.mark.parametrize("noise", [1e-5, 1e-3])
def test_a_log_that_begins_in_the_middle_of_a_motion_is_as_smooth_as_any(noise):
    time = PERIOD * np.arange(600)
    motion = np.sin(np.outer(time + 0.3, [3.0, 7.0]))
    random = np.random.default_rng(0)
    for cut in (slice(None), slice(57, 411)):
        log = motion[cut] + noise * random.normal(size=motion[cut].shape)
        smoother = Smoother(log)
        left = accelerations(smoother(log)) - accelerations(motion[cut])
        assert left[4:-4].std(axis=0).max() < 0.1 * accelerations(log - motion[cut]).std()
        assert smoother.noise == pytest.approx([noise, noise], rel=0.1)


def test_a_pendulum_near_its_own_frequency_is_told():
    """Its weight and its inertia almost cancel: a path that is not smooth tells no mass."""
    log = noisy(oscillator.simulated(600), 1e-3, 0.005, joints=oscillator.JOINTS)
    found = identify(log, oscillator.KNOWN, ["mass", "damping", "friction"], level=0.999)
    assert found.converged
    for name, true in oscillator.HIDDEN.items():
        assert found[name].low <= true <= found[name].high
    assert found["mass bar"].error < 0.01


def test_smoothing_does_not_reach_over_kinks():
    time = np.arange(200) * PERIOD
    positions = np.stack([np.abs(time - 0.5), np.sin(5 * time + 1.0)], axis=1)
    noise = 1e-4 * np.random.default_rng(0).normal(size=positions.shape)
    kinks = np.arange(200) == 100
    through, around = (Smoother(positions + noise, each) for each in (None, kinks))
    assert white_noise(positions + noise) == pytest.approx(1e-4, rel=0.2)
    left = around(positions + noise) - positions
    assert np.abs(left).max() < 4e-4
    assert np.diff(left, 2, axis=0).std() < 0.1 * np.diff(noise, 2, axis=0).std()
    kept, moved = (np.abs(each(positions) - positions)[:, 0].max() for each in (around, through))
    assert kept < 1e-9 and moved > 1e-4
