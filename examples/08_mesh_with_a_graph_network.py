"""Heat in a triangle mesh: a graph network from torch-geometric.

A plate with a hole conducts heat well in some places and badly in others: how warm is each node a
little later? A graph network knows which nodes are neighbors and only has to learn what happens
along an edge. A linear map and fully connected networks learn each node separately and do worse.

The network is a plain PyTorch class that knows nothing about physx: networks/heat.py.

    python examples/08_mesh_with_a_graph_network.py
"""

import sys
from pathlib import Path

import numpy as np
from common import compared, conclude, config, generate, options, samples
from environments.plate import Plate, mesh
from matplotlib.figure import Figure

from physx_core import Comparison


def draw(picture: Path, fields: dict[str, np.ndarray]) -> None:
    """Draw fields of the same samples side by side, one sample per row."""
    nodes, triangles = mesh()
    rows = len(fields["exact"])
    figure = Figure(figsize=(12, 2 * rows + 0.25), layout="constrained")
    places = figure.subplots(rows, len(fields))
    for row, line in enumerate(places):
        for place, (name, field) in zip(line, fields.items(), strict=True):
            colors = {} if "m²/s" in name else {"cmap": "coolwarm", "vmin": -2, "vmax": 2}
            place.tripcolor(*nodes.T, triangles, field[row], **colors)
            if place is line[0]:
                place.triplot(*nodes.T, triangles, color="black", linewidth=0.3)
            place.set(title=name if row == 0 else "", aspect="equal")
            place.axis("off")
    figure.savefig(picture, dpi=80)


def nothing_changes(given: dict[str, np.ndarray]) -> np.ndarray:
    """Return the temperature as it was."""
    return given["before"][..., :1]


def main() -> int:
    """Compare the networks; the exit status tells whether the graph network beats all others."""
    asked = options(__doc__).parse_args()
    count, epochs = (100, 2) if asked.small else (1000, 20)
    session = generate(Plate, count, asked.session_dir, as_tcp_ip_client=False)
    before, after = samples(session, "validation", "before", "after")
    kinds = {}
    for width in (128, 512):
        layers = [before[0].size, width, width, after[0].size]
        kinds[f"FC {width}"] = "torch/fc", {"layers": layers, "activation": "SiLU"}, 2e-3
    kinds["graph network"] = "networks.heat:HeatNetwork", {"channels": 32, "steps": 8}, 1e-2
    networks = {
        name: (config(kind, "before", "after", epochs, lr=lr, **arguments), epochs)
        for name, (kind, arguments, lr) in kinds.items()
    }
    results, guesses = compared(session, networks, "before", ["all", nothing_changes])
    if asked.picture:
        guess = guesses["graph network"]
        shown = {"temperature, K": before[..., 0], "conductivity, m²/s": before[..., 1]}
        shown |= {"exact": after[..., 0], "graph network": guess[..., 0]}
        shown |= {"its error": (guess - after)[..., 0]}
        shown |= {"error of FC 512": (guesses["FC 512"] - after)[..., 0]}
        draw(asked.picture, {name: field[:2] for name, field in shown.items()})
    comparison = Comparison.of(results, "error/after/relative_l2")
    return conclude(comparison, small=asked.small)


if __name__ == "__main__":
    sys.exit(main())
