"""A soft beam: a network that corrects linear elasticity.

Two clients push a clamped rubber beam at random places and find its equilibrium with felupe's
hyperelastic finite elements; its end moves by up to most of its length. Linear elasticity, its
stiffness factorized once, needs no samples and almost no time, but is wrong for large deflections.
A small network that corrects it beats larger ones that learn the whole displacement. That network
then runs in the environment: orange, over the solver's gray beam and linear elasticity's blue one.

    python examples/06_deformable_solid.py --picture beam.png
    physx view sessions/beam/beam.rrd
"""

import sys

import numpy as np
from common import SEEDS, compared, conclude, config, generate, linear_map, options, samples
from environments.beam import Beam, Timed

from physx_core import Comparison, EnvironmentConfig, NetworkConfig
from physx_rerun import render_picture

OWN = "linear elasticity + FC 256"
GRID = {"nb_dims": 3, "nb_input_channels": 3, "nb_first_layer_channels": 16, "nb_steps": 2}
GRID |= {"border_mode": "same", "two_sublayers": False, "positions": True}  # one end is clamped


def networks(epochs):
    """Return each network's configuration and number of epochs, by name."""
    made = {}
    for name, width in (("FC 128", 128), ("FC 512", 512), (OWN, 256)):
        sizes = {"layers": [768, width, width, 768], "activation": "SiLU"}
        made[name] = config("torch/fc", "forces", target(name), epochs, 2e-3, **sizes), epochs
    epochs //= 2
    unet = config("torch/unet", "forces", "correction", epochs, 2e-3, activation="SiLU", **GRID)
    return made | {"linear elasticity + UNet": (unet, epochs)}


def target(name):
    """Return what a network learns."""
    return "correction" if "elasticity" in name else "displacement"


def main():
    chosen = options(__doc__).parse_args()
    session = generate(Beam, 40 if chosen.small else 1600, chosen.session_dir, num_clients=2)
    known = samples(session, "training", "forces", "displacement")
    given, exact, missing = samples(session, "validation", "forces", "displacement", "correction")
    _, guesses = compared(session, networks(4 if chosen.small else 40), "forces", rivals=[])
    recording = {"visualizer": "rerun", "visualizer_kwargs": {"path": f"{session}/beam.rrd"}}
    beam = EnvironmentConfig(Beam, as_tcp_ip_client=False, seed=1, **recording)
    place = {"session_dir": f"{session}/networks", "session_name": f"{OWN} {SEEDS[0]}"}
    shown = Timed(NetworkConfig(), beam, step_nb=10 if chosen.small else 40, **place)
    shown.execute()
    if chosen.picture:
        step = int(np.argmax(shown.found, 0)[0]) + 1
        render_picture(f"{session}/beam.rrd", chosen.picture, (900, 450), at=step)
    text = "{:.1f} by finite elements, {:.2f} by linear elasticity, {:.2f} more for its correction"
    print("ms of the CPU for a push:", text.format(*1e3 * np.median(shown.found, 0)[1:]))
    linear = exact - missing
    found = {"linear elasticity": [linear], "linear map": [linear_map(*known)(given)]}
    for name, tried in guesses.items():
        found[name] = [each + linear if "elasticity" in name else each for each in tried]
    sizes = np.linalg.norm(exact.reshape(len(exact), -1), axis=1)
    errors = {
        name: [np.linalg.norm((g - exact).reshape(len(g), -1), axis=1) / sizes for g in tried]
        for name, tried in found.items()
    }
    worst = (f"{name} {errors[name][0].max():.0%}" for name in ("linear elasticity", OWN))
    print("worst push:", ", ".join(worst))
    means = {name: [float(each.mean()) for each in tried] for name, tried in errors.items()}
    comparison = Comparison(means, OWN, "relative error of a push", list(guesses))
    return conclude(comparison, small=chosen.small)


if __name__ == "__main__":
    sys.exit(main())
