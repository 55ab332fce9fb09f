"""Intervals of `physx identify`: do they hold, and does it say when they do not?

    python benchmarks/identify.py [--check] [--draws 200] [coverage] [contact] [panda]
                                  [derivatives] [engines] [standstill] [structure] [pairs]
                                  [excitation]

Coverage: the share of nominal 95 % intervals that hold the true value, of logs of 4 s at 200 Hz: a
pendulum that swings about its rest, three parameters; an arm of two links that tracks a motion,
six. Noise of torques (5 % of their deviation) with a correlation from sample to sample, of
encoders, of both. A cell of half as many logs each: the arm with late torques and an encoder that
is off; a robot that floats, 3 s, its base measured to 1 mm and 1 mrad; the same, 1 s, of which only
gravity acts on the base. The peer's own function, of MuJoCo's sysid, gets the least-squares
residual and Jacobian along the true path, where only torques are noisy.
Contact: logs of 2 s of a leg whose foot strikes the ground, with the noisy force of the ground,
with flags where it touches, and without, so that the model knows nothing of it.
Panda: seven joints, 20 s at 100 Hz, 5 % noise: errors, torques of another motion, a delay.
Derivatives: those of a fit against finite differences of Pinocchio's torques. Engines: logs of
each engine, all fitted on Pinocchio. Standstill: logs of MuJoCo, in which strong dry friction fades
as a joint stops, with little noise: how often they get their level, and whether their intervals
then hold. Structure: Stribeck friction that the model lacks, of several standard errors: how often
the tests find it, beside the best test, which knows what to look for. Pairs: two parameters that
act alike. Excitation: expected errors of the proposed motion relative to a sweep in frequency of
equal length and reach.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")  # the processes share the cores

import importlib
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any
from unittest.mock import MagicMock

import numpy as np
import pinocchio
from measure import claim, finish
from scipy.stats import norm

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "shared"))
import logged_arm as arm
import logged_flyer as flyer
import logged_leg as leg
import logged_oscillator as oscillator

from physx_core.typing import Vector
from physx_dart import PinocchioBackend
from physx_dart.pinocchio.models import load_model
from physx_identify import Estimate, Identification, Log, Model, identify, propose
from physx_identify.estimation.model import STRIBECK
from physx_identify.estimation.model import Path as Motion
from physx_identify.excitation import expected_errors
from physx_identify.unknowns import as_unknowns
from physx_mujoco import MujocoBackend
from physx_sim import JointSettings, Robot

UNKNOWN = ("mass", "damping", "friction")
SAMPLES = 800
SIZES = (2.0, 3.0, 3.6, 5.0, 7.0)
"""Stribeck friction that the model lacks, in standard errors of its value if it were unknown."""
CORRELATIONS = (0.0, 0.9, 0.98)
CELLS = {
    "torque": (1e-6, 0.05),
    "fine": (1e-5, 0.05),
    "encoder": (1e-3, 0.005),
    "both": (1e-4, 0.05),
}
"""Noise of encoders in rad, and of torques relative to their deviation."""


@cache
def clean(engine: type = PinocchioBackend) -> tuple[Vector, Vector]:
    """Return the arm's motion and torques without noise."""
    motion: tuple[Vector, Vector] = arm.simulated(samples=SAMPLES, engine=engine)
    return motion


@cache
def late() -> tuple[Vector, Vector]:
    """Return the arm's, with torques that are late and an encoder that is off."""
    positions, torques = arm.simulated(samples=SAMPLES + LATE)
    return positions[LATE:] + np.array([OFF, 0.0]), torques[:-LATE]


@cache
def swung() -> tuple[Vector, Vector]:
    """Return those of the pendulum."""
    motion: tuple[Vector, Vector] = oscillator.simulated(SAMPLES)
    return motion


@cache
def flown(samples: int, friction: bool) -> tuple[Vector, Vector]:
    """Return those of the robot that floats, with or without dry friction."""
    motion: tuple[Vector, Vector] = flyer.flown(flyer.hidden(friction), samples)
    return motion


LATE, OFF = 2, 0.02
"""Delay of torques in samples; offset of the shoulder's encoder in rad."""


@dataclass(frozen=True)
class Case:
    """Logs with hidden parameters.

    Attributes:
        robot: As it is known.
        unknowns: What is to be found.
        hidden: True values by name.
        log: Makes a log, from noise of encoders in rad, noise of torques relative to their
            deviation, its correlation from sample to sample, and a seed.
        flight: Whether only gravity acts on the base.
    """

    robot: Robot
    unknowns: Sequence[str]
    hidden: Mapping[str, float]
    log: Callable[[float, float, float, int], Log]
    flight: bool = False

    def found(self, cell: str, correlation: float, seed: int) -> Identification:
        """Return what a log with a draw of noise says."""
        log = self.log(*CELLS[cell], correlation, seed)
        return identify(log, self.robot, self.unknowns, flight=self.flight)


CASES = {
    "arm": Case(arm.KNOWN, UNKNOWN, arm.HIDDEN, lambda *noise: arm.noisy(clean(), *noise)),
    "pendulum": Case(
        oscillator.KNOWN,
        UNKNOWN,
        oscillator.HIDDEN,
        lambda *noise: arm.noisy(swung(), *noise, oscillator.JOINTS),
    ),
    "late arm": Case(
        arm.KNOWN,
        [*UNKNOWN, "delay", "encoder:shoulder"],
        arm.HIDDEN | {"delay": LATE * arm.PERIOD, "encoder shoulder": OFF},
        lambda *noise: arm.noisy(late(), *noise),
    ),
    "floating": Case(
        flyer.KNOWN,
        ["mass:lower", "damping", "friction"],
        flyer.HIDDEN,
        lambda *noise: flyer.noisy(flown(600, True), 1e-3, *noise),
    ),
    "flight": Case(
        flyer.KNOWN,
        ["mass:lower", "damping"],
        {name: value for name, value in flyer.HIDDEN.items() if "friction" not in name},
        lambda *noise: flyer.noisy(flown(200, False), 1e-3, *noise),
        flight=True,
    ),
}


def draw(job: tuple[str, str, float, int]) -> tuple[list[bool], bool] | None:
    """Return which intervals of a draw hold, and whether a test failed; None: no intervals."""
    case = CASES[job[0]]
    result = case.found(*job[1:])
    if not result.converged:
        return None
    held = [result[n].low <= true <= result[n].high for n, true in case.hidden.items()]
    return held, bool(result.lacks)


def sysid() -> Any:
    """Return the module of MuJoCo's intervals, without what it prints and plots with."""
    while True:
        try:
            return importlib.import_module("mujoco.sysid._src.optimize")
        except ModuleNotFoundError as error:
            sys.modules[str(error.name)] = MagicMock()


def peer(correlation: float, seed: int) -> list[bool]:
    """Return which intervals of MuJoCo's sysid hold."""
    positions, torques = clean()
    log = arm.noisy((positions, torques), 0.0, 0.05, correlation, seed)
    model = Model(arm.KNOWN)
    parameters = model.parameters(as_unknowns(UNKNOWN))
    path = Motion(positions, arm.PERIOD)
    directions = np.stack([model.direction(each) for each in parameters], axis=1)
    nominal = np.array([each.nominal for each in parameters])
    given = np.column_stack([directions, model.numbers - directions @ nominal])
    columns = model.columns(path, given, path.ends)
    scale = 1 / torques.std(axis=0)[None, :, None]
    jacobian = (columns[..., :-1] * scale).reshape(-1, len(parameters))
    target = ((log.torques[1:-1] - columns[..., -1]) * scale[..., 0]).ravel()
    values = np.linalg.lstsq(jacobian, target, rcond=None)[0]
    _, half = sysid().calculate_intervals([target - jacobian @ values], jacobian)
    true = np.array(list(arm.HIDDEN.values()))
    inside: list[bool] = (np.abs(values - true) <= half).tolist()
    return inside


def covered(
    pool: ProcessPoolExecutor, case: str, cell: str, correlation: float, first: int, draws: int
) -> tuple[bool, int]:
    """Print the share of intervals that hold in a cell.

    Returns:
        Whether it is as claimed; how many logs were called model error.
    """
    jobs = [(case, cell, correlation, first + seed) for seed in range(draws)]
    results = [each for each in pool.map(draw, jobs, chunksize=4) if each is not None]
    held = np.array([each for each, _ in results])
    false = sum(failed for _, failed in results)
    print(
        f"  {case:9}noise of {cell:8}correlation {correlation:4}: {held.mean():.3f}, worst "
        f"parameter {held.mean(axis=0).min():.2f}, without an interval {draws - len(held)}, "
        f"called model error {false}, {draws} draws",
        flush=True,
    )
    name = f"{case}, {cell}, {correlation}"
    good = claim(f"{name}: pooled", held.mean(), at_least=0.90)
    good &= claim(f"{name}: too wide", held.mean(), at_most=0.98)
    good &= claim(f"{name}: worst parameter", held.mean(axis=0).min(), at_least=0.85)
    return good, false


def coverage(draws: int) -> bool:
    """Print the share of intervals that hold in each cell."""
    print("Intervals that hold the true value")
    good, first = True, 0  # draws of their own
    with ProcessPoolExecutor() as pool:
        for correlation in CORRELATIONS:
            shares = pool.map(peer, [correlation] * draws, range(draws), chunksize=4)
            share = float(np.mean(list(shares)))
            print(f"  MuJoCo sysid      noise of torques, correlation {correlation:4}: {share:.3f}")
        for case in ("arm", "pendulum"):
            flagged = dict.fromkeys(CORRELATIONS, 0)
            for cell in CELLS:
                for correlation in CORRELATIONS:
                    met, false = covered(pool, case, cell, correlation, first, draws)
                    good, first = good and met, first + 1000
                    flagged[correlation] += false
            for correlation, false in flagged.items():
                name = f"{case}: clean logs called model error, correlation {correlation}"
                good &= claim(name, false / (draws * len(CELLS)), at_most=0.05)
        for case in ("late arm", "floating", "flight"):
            met, _ = covered(pool, case, "both", 0.9, first, draws // 2)
            good, first = good and met, first + 1000
    return good


PANDA, FINGERS = "panda/panda", ("panda_finger_joint1", "panda_finger_joint2")
ARM_PERIOD, LATENESS = 0.01, 0.013
"""Of the Panda's logs, in s: period, and delay of the torques where they have one."""


def panda_model() -> Model:
    """Return a Panda with the hidden friction, damping and armature."""
    names = Model(Robot(PANDA, collisions="none"), held=FINGERS).joints
    true = {name: JointSettings(damping=0.5, friction=0.8, armature=0.1) for name in names}
    return Model(Robot(PANDA, collisions="none", joints=true), held=FINGERS)


def reaching(model: Model, seed: int, late: float = 0.0) -> Motion:
    """Return a motion of 20 s, by some seconds late."""
    random = np.random.default_rng(seed)
    joints = model.movable.model.joints
    middle = np.array([0.5 * (each.lower + each.upper) for each in joints])
    reach = np.array([0.3 * (each.upper - each.lower) for each in joints])
    rates = 2 * np.pi * np.linspace(0.05, 0.5, 8)
    phases = random.uniform(0, 6.28, (len(joints), len(rates)))
    moments = np.arange(2000) * ARM_PERIOD - late
    waves = np.stack([np.sin(np.outer(moments, rates) + own).sum(axis=1) / 4 for own in phases], 1)
    return Motion(middle + reach * waves, ARM_PERIOD)


def torques_of(model: Model, motion: Motion) -> Vector:
    """Return the torques along a motion, shape (samples - 2, joints)."""
    dry = model.dry(motion, model.stencil(motion, model.numbers), model.numbers)
    return model.columns(motion, model.numbers[:, None], motion.ends, dry)[..., 0]


def panda_log(model: Model, late: float = 0.0) -> Log:
    """Return a log with 5 % noise of torques, which may be late."""
    motion, random = reaching(model, 0), np.random.default_rng(1)
    torques = torques_of(model, reaching(model, 0, late))
    torques = torques + 0.05 * torques.std(axis=0) * random.standard_normal(torques.shape)
    noisy = motion.positions + 1e-5 * random.standard_normal(motion.positions.shape)
    return Log(model.joints, ARM_PERIOD, noisy, np.pad(torques, ((1, 1), (0, 0)), mode="edge"))


def bound(model: Model, found: Identification) -> Vector:
    """Return the Cramér-Rao bounds of the estimates that are told, as deviations.

    Engines apply dry friction in two ways; which one a log has is as unknown as a value of which a
    half is known, give or take a half.
    """
    unknown = model.parameters(as_unknowns([f"{e.kind}:{e.of}" for e in found.estimates]))
    motion, count = reaching(model, 0), len(model.joints)
    directions = np.stack([model.direction(each) for each in unknown], axis=1)
    rubbing = np.zeros((len(model.numbers), count))
    rubbing[11 * count : 12 * count] = np.diag(model.numbers[11 * count : 12 * count])
    dry = model.dry(motion, model.stencil(motion, model.numbers), model.numbers)
    ways = [model.columns(motion, rubbing, motion.ends, each) for each in (dry, None)]
    columns = [model.columns(motion, directions, motion.ends), ways[0] - ways[1]]
    scale = 0.05 * torques_of(model, motion).std(axis=0)
    white = (np.concatenate(columns, axis=2) / scale[:, None]).reshape(-1, len(unknown) + count)
    told = white.T @ white + np.diag([0.0] * len(unknown) + [1 / 0.5**2] * count)
    inverse = np.linalg.inv(told + 1e-9 * np.diag(np.diag(told)))  # some are inseparable
    bounds: Vector = np.sqrt(np.diag(inverse))
    return bounds[[place for place, each in enumerate(found.estimates) if each.error]]


def panda() -> bool:
    """Print how well a Panda is found from 20 s, and how long it takes."""
    model, known = panda_model(), Robot(PANDA, collisions="none")
    kinds = ("damping", "friction", "armature")
    unknown = [f"{kind}:{name}" for kind in kinds for name in model.joints]
    unknown += [f"mass:{b.name}" for b in model.movable.model.bodies if b.name in LINKS]
    log = panda_log(model)
    begin = time.process_time()
    result = identify(log, known, unknown, held=FINGERS)
    seconds = time.process_time() - begin
    inside, errors = [], []
    for each in result.estimates:
        if not each.error:
            print(f"  {each.name}: inseparable")
            continue
        value = {"damping": 0.5, "friction": 0.8, "armature": 0.1}.get(each.kind, each.nominal)
        inside.append(each.low is not None and each.low <= value <= (each.high or 0.0))
        errors.append(each.value - value)
        if each.kind == "mass":
            print(f"  {each.name}: {100 * (each.error / each.nominal):.2f} % standard error")
    print(f"  converged: {result.converged}; lacks {result.lacks or 'nothing'}")
    print(f"  {np.sum(inside)} of {len(inside)} intervals hold; {seconds:.0f} s of processor time")
    good = claim("Panda: intervals that hold", float(np.mean(inside)), at_least=0.85)
    good &= claim("Panda: seconds of processor time", seconds, at_most=60)
    least = bound(model, result)
    ratio = float(np.sqrt(np.mean((np.array(errors) / least) ** 2)))
    good &= claim("Panda: errors relative to their Cramér-Rao bounds, rms", ratio, at_most=1.5)
    stated = np.array([each.error for each in result.estimates if each.error]) / least
    good &= claim("Panda: largest standard error relative to it", float(stated.max()), at_most=1.5)
    other = Model(result.applied_to(known), held=FINGERS)
    motion = reaching(model, 2)
    true = torques_of(model, motion)
    missed = np.sqrt(np.mean((torques_of(other, motion) - true) ** 2) / np.mean(true**2))
    good &= claim("Panda: torques of another motion, relative rms", float(missed), at_most=0.012)
    late = identify(panda_log(model, LATENESS), known, [*unknown, "delay"], held=FINGERS)["delay"]
    print(f"  delay of {1e3 * LATENESS:.0f} ms: {1e3 * late.value:.2f} ms")
    return (
        claim("Panda: seconds off in the delay", abs(late.value - LATENESS), at_most=1e-3) and good
    )


def derivatives() -> bool:
    """Print the processor time of exact derivatives relative to finite differences."""
    model, motion = panda_model(), reaching(panda_model(), 0)
    kinds = ("damping", "friction", "armature")
    unknown = model.parameters(as_unknowns([*kinds, *(f"mass:{link}" for link in LINKS)]))
    directions = np.stack([model.direction(each) for each in unknown], axis=1)
    plain = load_model(model.movable, model.gravity, armature=np.zeros(len(model.joints)))
    data = plain.createData()
    rows = list(zip(motion.own, motion.velocities, motion.accelerations, strict=True))

    def rollout() -> None:
        for q, v, a in rows:
            pinocchio.rnea(plain, data, q, v, a)

    def exact() -> None:
        model.columns(motion, directions, motion.ends)
        model.stencil(motion, model.numbers)

    spent: dict[Callable[[], None], list[float]] = {rollout: [], exact: []}
    for _ in range(5):
        for work, times in spent.items():
            begin = time.process_time()
            work()
            times.append(time.process_time() - begin)
    differences = (len(unknown) + 1 + 3 * len(model.joints)) * float(np.median(spent[rollout]))
    ratio = float(np.median(spent[exact])) / differences
    print(f"  derivatives by {len(unknown)} parameters and by three neighboring positions")
    return claim("processor time relative to finite differences", ratio, at_most=1 / 3)


LINKS = tuple(f"panda_link{number}" for number in range(1, 8))


def engines() -> bool:
    """Print whether logs of other engines are told, or called model error."""
    good = True
    for engine in arm.ENGINES:
        log = arm.noisy(clean(engine))
        result = identify(log, arm.KNOWN, UNKNOWN)
        inside = [result[n].low <= true <= result[n].high for n, true in arm.HIDDEN.items()]
        lacks = result.lacks or "nothing"
        print(f"  log of {engine.__name__}: {sum(inside)} of 6 hold; lacks {lacks}")
        good &= sum(inside) >= 5 or not result.holds
    return claim("told or called model error", float(good), at_least=1)


STRONG = {
    "shoulder": JointSettings(damping=0.5, friction=0.8),
    "elbow": JointSettings(damping=0.2, friction=0.3),
}


@cache
def stopped() -> tuple[Vector, Vector]:
    """Return motion and torques of an arm with strong dry friction, in MuJoCo."""
    robot = Robot("double_pendulum", joints=STRONG, mass_factors={"lower": 1.2})
    motion: tuple[Vector, Vector] = arm.simulated(robot, SAMPLES, MujocoBackend)
    return motion


def leveled(job: tuple[float, int]) -> list[bool] | None:
    """Return which intervals of dry friction hold in a log; None: it does not get its level."""
    result = identify(arm.noisy(stopped(), torque=job[0], seed=job[1]), arm.KNOWN, UNKNOWN)
    if not result.holds:
        return None
    found = {name: result[f"friction {name}"] for name in STRONG}
    return [found[name].low <= STRONG[name].friction <= found[name].high for name in STRONG]


def standstill(draws: int) -> bool:
    """Print how often logs of joints that MuJoCo's dry friction stops get their level."""
    jobs = [(noise, 1000 + seed) for noise in (0.01, 0.005) for seed in range(draws // 2)]
    with ProcessPoolExecutor() as pool:
        results = [each for each in pool.map(leveled, jobs, chunksize=4) if each is not None]
    held = float(np.mean(results))
    print(
        f"  logs of MuJoCo with strong dry friction: {len(results)} of {len(jobs)} get their "
        f"level; {held:.3f} of the intervals of friction hold"
    )
    good = claim("strong dry friction: level", len(results) / len(jobs), at_least=0.9)
    return claim("strong dry friction: intervals that hold", held, at_least=0.9) and good


def rubbing(newton_meters: float, seed: int) -> Log:
    """Return a log with Stribeck friction of the shoulder, which the model lacks."""
    positions, torques = clean()
    ends = np.pad(Motion(positions, arm.PERIOD).ends[:, 0], 1, mode="edge")
    more = newton_meters * np.sign(ends) * np.exp(-np.abs(ends) / STRIBECK)
    log: Log = arm.noisy((positions, torques + np.stack([more, 0 * more], axis=1)), seed=seed)
    return log


def told(log: Log) -> Estimate:
    """Return the Stribeck friction of the shoulder that a log tells, if it is known to be there."""
    return identify(log, arm.KNOWN, [*UNKNOWN, "stribeck:shoulder"])["stribeck shoulder"]


def seen(job: tuple[float, int]) -> tuple[bool, bool]:
    """Return whether hidden friction is called model error, and whether the best test finds it."""
    log = rubbing(*job)
    best = told(log)
    alone = best.low is not None and not best.low <= 0.0 <= (best.high or 0.0)
    return bool(identify(log, arm.KNOWN, UNKNOWN).lacks), alone


def structure(draws: int) -> bool:
    """Print how often hidden friction is found, beside the best test of the same size."""
    shares = {}
    with ProcessPoolExecutor() as pool:
        error = float(np.mean([told(rubbing(0.0, seed)).error or np.inf for seed in range(4)]))
        for size in SIZES:
            jobs = [(size * error, 1000 + seed) for seed in range(draws)]
            found_, best = np.mean(list(pool.map(seen, jobs)), axis=0)
            at_best = norm.sf(norm.isf(0.025) - size)
            print(
                f"  Stribeck friction of {size} standard errors: called model error {found_:.2f}, "
                f"found by the test that knows it {best:.2f}, in theory {at_best:.2f}",
                flush=True,
            )
            shares[size] = found_
    least = norm.isf(0.025) + norm.isf(0.05)
    print(f"  19 of 20 takes {least:.1f} standard errors, even of a test that knows it")
    good = claim("hidden friction of 5 standard errors", shares[5.0], at_least=0.85)
    return claim("hidden friction of 7 standard errors", shares[7.0], at_least=0.95) and good


_STEPPING: list[tuple[Vector, Vector, Vector]] = []


def stepping() -> tuple[Vector, Vector, Vector]:
    """Return motion and torques of a leg whose foot strikes the ground, and its forces."""
    if not _STEPPING:
        _STEPPING.append(leg.stepping())
    return _STEPPING[0]


def told_of_leg(seed: int) -> bool:
    """Return whether a leg's log without contacts is told by intervals that are called 95 %."""
    log = arm.noisy(stepping()[:2], correlation=0.9, seed=seed)
    return identify(log, leg.KNOWN, UNKNOWN).holds


def draw_of_leg(job: tuple[str, float, int]) -> tuple[list[bool], bool] | None:
    """Return which intervals of a leg hold, and whether a test failed; None: no intervals."""
    known, correlation, seed = job
    make = leg.sensed if known == "forces" else leg.flagged
    result = identify(make(stepping(), correlation=correlation, seed=seed), leg.KNOWN, UNKNOWN)
    if not result.converged:
        return None
    held = [result[n].low <= true <= result[n].high for n, true in leg.HIDDEN.items()]
    return held, bool(result.lacks)


MOST_FLAGGED = 0.9
"""Largest correlation at which 2 s with gaps tell the noise well enough for a claim."""


def contact(draws: int) -> bool:
    """Print how often intervals of a leg hold, and how often logs without contacts are refused."""
    good = True
    with ProcessPoolExecutor() as pool:
        refused = 1 - float(np.mean(list(pool.map(told_of_leg, range(draws)))))
        print(
            f"  logs of a leg without its contacts, {draws} draws: level refused in {refused:.2f}"
        )
        for row, known in enumerate(("forces", "flags")):
            for column, correlation in enumerate(CORRELATIONS):
                first = 1000 * (len(CORRELATIONS) * row + column)
                jobs = [(known, correlation, first + seed) for seed in range(draws)]
                results = [x for x in pool.map(draw_of_leg, jobs) if x is not None]
                held = np.array([each for each, _ in results])
                print(
                    f"  contact {known:6} correlation {correlation:4}: {held.mean():.3f}, worst "
                    f"parameter {held.mean(axis=0).min():.2f}, without an interval "
                    f"{draws - len(held)}, called model error {sum(each for _, each in results)}",
                    flush=True,
                )
                if known == "flags" and correlation > MOST_FLAGGED:
                    continue
                name = f"contact {known}, {correlation}"
                good &= claim(f"{name}: pooled", held.mean(), at_least=0.90)
                good &= claim(f"{name}: too wide", held.mean(), at_most=0.98)
                good &= claim(f"{name}: worst parameter", held.mean(axis=0).min(), at_least=0.85)
    return claim("contacts: level refused", refused, at_least=0.95) and good


PAIR = ("armature shoulder", "Iyy upper")
"""The rotor of the shoulder and the link that it turns, about the same axis."""


def alike(seed: int) -> bool:
    """Return whether it is said of a log that no part of it tells a pair apart."""
    log = arm.noisy(clean(), correlation=0.9, seed=seed)
    result = identify(log, arm.KNOWN, [*UNKNOWN[1:], "armature:shoulder", "inertia:upper"])
    return all(result[name].verdict == "inseparable" for name in PAIR)


def pairs(draws: int) -> bool:
    """Print how often it is said that two parameters cannot be told apart."""
    with ProcessPoolExecutor() as pool:
        share = float(np.mean(list(pool.map(alike, range(draws)))))
    return claim(
        f"logs of {draws} in which {' and '.join(PAIR)} are inseparable", share, at_least=1
    )


def excitation() -> bool:
    """Print how much the proposed motion tells relative to a sweep."""
    result = CASES["arm"].found("both", 0.9, 0)
    motion = propose(result, arm.KNOWN)
    moments = result.period * np.arange(len(motion.positions))
    sweep = np.sin(2 * np.pi * (0.2 + 0.15 * moments) * moments)[:, None] * result.farthest
    speed = np.abs(np.gradient(sweep, result.period, axis=0)).max(axis=0)
    sweep *= 0.9 * np.minimum(1, result.fastest / speed)
    swept = expected_errors(result, arm.KNOWN, sweep)
    ratios = [motion.errors[name] / swept[name] for name in motion.errors]
    mean = float(np.exp(np.mean(np.log(ratios))))
    print(f"  expected errors relative to a sweep: {mean:.2f} (geometric mean)")
    return claim("proposed relative to a sweep", mean, at_most=0.5)


def main(words: list[str]) -> None:
    """Run the parts that are named, or all."""
    draws = int(words[words.index("--draws") + 1]) if "--draws" in words else 200
    parts: dict[str, Callable[[], bool]] = {
        "coverage": lambda: coverage(draws),
        "contact": lambda: contact(min(draws, 100)),
        "panda": panda,
        "derivatives": derivatives,
        "engines": engines,
        "standstill": lambda: standstill(min(draws, 60)),
        "structure": lambda: structure(min(draws, 40)),
        "pairs": lambda: pairs(20),
        "excitation": excitation,
    }
    chosen = [name for name in parts if name in words] or list(parts)
    finish([parts[name]() for name in chosen])


if __name__ == "__main__":
    main(sys.argv[1:])
