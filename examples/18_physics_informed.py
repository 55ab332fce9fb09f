"""Equations of motion inside the loss.

A double pendulum has friction in its joints; its model has none. From 500 samples (q, v, torque) ->
acceleration, a network learns the torques that the model lacks, although nobody measured them: the
loss is that of the accelerations, and gradients flow through the equations of motion. Rivals are
networks without the model, one that corrects its accelerations, a linear map, and linear friction.

    python examples/18_physics_informed.py
"""

import torch
from common import SEEDS, conclude, config, options, trained
from environments.double_pendulum import FIELDS, error, linear, measure, missing, pendulum, store
from environments.double_pendulum_picture import draw

from physx_core import Comparison
from physx_torch import ForwardDynamics

NETWORK = "network in the model"
KINDS = {  # what is predicted, from what, and width
    "network of width 64": ("acceleration", "seen", 64),
    "network of width 128": ("acceleration", "seen", 128),
    "model + network": ("missing acceleration", "seen", 128),
    NETWORK: ("missing torque", "v", 64),
}


def accelerations(model, what, guess, q, v, torque):
    """Return what follows from a prediction, by the equations of motion."""
    if what == "missing torque":
        return model(q, v, torque - guess)
    return guess if what == "acceleration" else model(q, v, torque) + guess


def train(session, model, kind, epochs, seed):
    """Train a network; return it, and a function that computes accelerations with it."""
    what, given, width = kind

    def loss(batch):
        *measured, wanted = (batch.data[name] for name in FIELDS)
        found = accelerations(model, what, batch.physical_prediction[what], *measured)
        return torch.nn.functional.smooth_l1_loss(found, wanted)

    sizes = {"layers": [2 if given == "v" else 8, width, width, 2], "activation": "Tanh"}
    own = {"loss": loss, "data_type": "float64", "optimization_kwargs": {"extra_fields": FIELDS}}
    made = config("torch/fc", given, "acceleration", epochs, 3e-3, own, pred_fields=what, **sizes)
    learner = trained(session, made, epochs, seed, batch_size=500, normalize=False).learner

    def network(values):
        return torch.from_numpy(learner.predict({given: values.numpy()})[what])

    def acceleration(q, v, torque):
        seen = v if given == "v" else torch.hstack([q.sin(), q.cos(), v, torque])
        return accelerations(model, what, network(seen), q, v, torque)

    return network, acceleration


def main():
    chosen = options(__doc__).parse_args()
    rows, epochs, seeds = (200, 150, SEEDS[:1]) if chosen.small else (500, 1000, SEEDS)
    with pendulum("dart", friction=True) as real, pendulum("pinocchio", friction=False) as simple:
        known, unseen = measure(real, rows, seed=0), measure(real, 1000, seed=1)
        session = store(chosen.session_dir / "double_pendulum", known, unseen)
        model, law = ForwardDynamics(simple), linear([known[1]], missing(simple, known))
        ways = {"linear map": [linear(known[:3], known[3])], "model without friction": [model]}
        ways["model + linear friction"] = [lambda q, v, torque: model(q, v, torque - law(v))]
        for name, kind in KINDS.items():
            networks = [train(session, model, kind, epochs, seed) for seed in seeds]
            ways[name] = [way for _, way in networks]
        errors = {name: [error(way, unseen) for way in found] for name, found in ways.items()}
        if chosen.picture:
            draw(chosen.picture, real, model, law, *networks[0])
    return conclude(Comparison(errors, NETWORK, networks=list(KINDS)), small=chosen.small)


if __name__ == "__main__":
    raise SystemExit(main())
