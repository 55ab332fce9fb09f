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
import time

import numpy as np
from common import SEEDS, config, generate, learned, options, samples
from environments.beam import Beam
from rivals import linear_map, relative_error, verdict

from physx_core import EnvironmentConfig, NetworkConfig, Prediction
from physx_rerun import render_picture

OWN = "linear elasticity + FC 256"
GRID = {"nb_dims": 3, "nb_input_channels": 3, "nb_first_layer_channels": 16, "nb_steps": 2}
GRID |= {"border_mode": "same", "two_sublayers": False, "positions": True}  # one end is clamped


def networks(epochs):
    """Yield each network's name, kind, target, epochs and arguments."""
    for name, width in (("FC 128", 128), ("FC 512", 512), (OWN, 256)):
        wanted = "correction" if name == OWN else "displacement"
        yield name, "torch/fc", wanted, epochs, {"layers": [768, width, width, 768]}
    yield "linear elasticity + UNet", "torch/unet", "correction", epochs // 2, GRID


class Timed(Prediction):
    """Records each push's deflection and the CPU s of solver, linear elasticity and network."""

    found = ()

    def sample_end(self):
        begin = time.thread_time()
        self.learner.predict(self.batch)
        seconds = *self.batch["seconds"][0], time.thread_time() - begin
        self.found += ((np.linalg.norm(self.batch["displacement"]), *seconds),)


def main():
    chosen = options(__doc__).parse_args()
    session = generate(Beam, 40 if chosen.small else 1600, chosen.session_dir, num_clients=2)
    known = samples(session, "training", "forces", "displacement")
    given, exact, missing = samples(session, "validation", "forces", "displacement", "correction")
    linear = exact - missing
    guesses = {"linear elasticity": [linear], "ridge regression": [linear_map(*known)(given)]}
    for name, kind, wanted, epochs, arguments in networks(4 if chosen.small else 40):
        network = config(kind, "forces", wanted, epochs, 2e-3, activation="SiLU", **arguments)
        base = linear if wanted == "correction" else 0
        own = [{"seed": seed, "session_name": f"{name} {seed}"} for seed in SEEDS]
        guesses[name] = [base + learned(session, network, "forces", epochs, **o) for o in own]
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
    worst = {n: max(map(relative_error, g[0][:, None], exact[:, None])) for n, g in guesses.items()}
    print(f"worst push: linear elasticity {worst['linear elasticity']:.0%}, {OWN} {worst[OWN]:.0%}")
    errors = {n: [relative_error(each, exact) for each in all] for n, all in guesses.items()}
    return verdict(errors, OWN, small=chosen.small, networks=[name for name, *_ in networks(0)])


if __name__ == "__main__":
    sys.exit(main())
