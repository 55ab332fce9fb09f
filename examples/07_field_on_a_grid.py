"""Turbulence on a grid: a Fourier neural operator and a UNet.

Vortices stir each other: what will the flow look like in one second? The equation is nonlinear: a
linear map and fully connected networks get half of it wrong. The UNet that comes with physx does
better, and neuraloperator's FNO, which works with waves on the periodic square, does far better.
The FNO is a plain PyTorch class, as any of yours may be.

    python examples/07_field_on_a_grid.py
"""

import sys
from pathlib import Path

import neuralop
import numpy as np
import torch
from common import compared, conclude, config, generate, options, samples
from environments.vortices import POINTS, Vortices
from matplotlib.figure import Figure

from physx_core import Comparison


class FNO(neuralop.models.FNO):
    """Neuraloperator's FNO for fields with channels last, (samples, x, y, channels)."""

    def forward(self, field: torch.Tensor) -> torch.Tensor:
        return super().forward(field.movedim(-1, 1)).movedim(1, -1)


def draw(picture: Path, fields: dict[str, np.ndarray]) -> None:
    """Draw fields of the same samples side by side, one sample per row."""
    rows = len(fields["exact"])
    figure = Figure(figsize=(12, 2.05 * rows + 0.25), layout="constrained")
    places = figure.subplots(rows, len(fields))
    for row, line in enumerate(places):
        for place, (name, field) in zip(line, fields.items(), strict=True):
            place.imshow(field[row, ..., 0].T, "RdBu", vmin=-3, vmax=3, interpolation="bicubic")
            place.set(title=name if row == 0 else "", xticks=[], yticks=[])
    figure.savefig(picture, dpi=80)


def main() -> int:
    """Compare the networks; the exit status tells whether the FNO beats all others."""
    asked = options(__doc__).parse_args()
    count, epochs = (100, 2) if asked.small else (1000, 15)
    session = generate(Vortices, count, asked.session_dir, as_tcp_ip_client=False)
    grid = {"in_channels": 1, "out_channels": 1, "hidden_channels": 16, "n_layers": 3}
    unet = {"nb_dims": 2, "nb_output_channels": 1, "nb_first_layer_channels": 12, "nb_steps": 2}
    kinds = {}
    for width in (128, 512):
        layers = [POINTS**2, width, width, POINTS**2]
        kinds[f"FC {width}"] = "torch/fc", {"layers": layers, "activation": "SiLU"}
    kinds["UNet"] = "torch/unet", {**unet, "border_mode": "same", "activation": "SiLU"}
    kinds["FNO"] = f"{__file__}:FNO", {"n_modes": [12, 12], **grid}
    networks = {
        name: (config(kind, "now", "later", epochs, lr=4e-3, **arguments), epochs)
        for name, (kind, arguments) in kinds.items()
    }
    results, guesses = compared(session, networks, "now")
    if asked.picture:
        now, later = samples(session, "validation", "now", "later")
        del guesses["FC 128"]
        first = {name: guess for name, (guess, *_) in guesses.items()}
        missed = first["FNO"] - later
        shown = {"given": now, "exact": later, **first, "error of the FNO": missed}
        draw(asked.picture, {name: field[:2] for name, field in shown.items()})
    comparison = Comparison.of(results, "error/later/relative_l2")
    return conclude(comparison, small=asked.small)


if __name__ == "__main__":
    sys.exit(main())
