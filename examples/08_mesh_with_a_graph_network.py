"""Heat in triangle meshes of any size: a graph network from torch-geometric.

Plates with a hole or without a corner, of 20 to 2 000 nodes, conduct heat well in some places and
badly in others: how warm is each node a little later? Every sample stores its own mesh, and batches
join meshes end to end. The network knows which nodes are neighbors and only has to learn what
happens along an edge. It is compared with the general graph network that comes with physx, and with
what needs none. It is a plain PyTorch class that knows nothing about physx: networks/heat.py.

    python examples/08_mesh_with_a_graph_network.py
    physx export sessions/plate p.hdf --to vtkhdf --mode validation --points place --cells triangle
"""

import sys
from pathlib import Path

import numpy as np
from common import compared, conclude, config, generate, options, samples
from environments.plate import Plate
from matplotlib.figure import Figure

from physx_core import Comparison

FIELDS = ["place", "edge", "before"]


def draw(picture: Path, meshes: tuple, fields: dict[str, list[np.ndarray]]) -> None:
    """Draw values at the nodes of meshes side by side, one mesh per row."""
    rows = len(meshes[0])
    figure = Figure(figsize=(12, 2.4 * rows + 0.25), layout="constrained")
    places = figure.subplots(rows, len(fields))
    for row, line in enumerate(places):
        nodes, triangles = (each[row] for each in meshes)
        for place, (name, values) in zip(line, fields.items(), strict=True):
            colors = {} if "m²/s" in name else {"cmap": "coolwarm", "vmin": -2, "vmax": 2}
            place.tripcolor(*nodes.T, triangles, values[row], **colors)
            if place is line[0]:
                place.triplot(*nodes.T, triangles, color="black", linewidth=0.3)
            place.set(title=name if row == 0 else "", aspect="equal")
            place.axis("off")
    figure.savefig(picture, dpi=80)


def nothing_changes(given: dict[str, np.ndarray]) -> np.ndarray:
    """Return the temperature as it was."""
    return given["before"][..., :1]


def main() -> int:
    """Compare; the exit status tells whether the network for heat beats all others."""
    asked = options(__doc__).parse_args()
    count, epochs = (60, 2) if asked.small else (240, 10)
    session = generate(Plate, count, asked.session_dir, as_tcp_ip_client=False)
    kinds = {
        "graph network of physx": ("torch/graph", {"nodes": 4, "outputs": 1, "hidden": 32}, 5e-3),
        "network for heat": ("networks.heat:HeatNetwork", {"channels": 32, "steps": 12}, 1e-2),
    }
    networks = {
        name: (config(kind, FIELDS, "after", epochs, lr=lr, **arguments), epochs)
        for name, (kind, arguments, lr) in kinds.items()
    }
    how = {"rivals": ["all", nothing_changes], "batch_size": 4}
    results, guesses = compared(session, networks, FIELDS, **how)
    if asked.picture:
        every = samples(session, "validation", "place", "triangle", "before", "after")
        sizes = np.argsort([len(nodes) for nodes in every[0]])
        shown = [sizes[len(sizes) // 3], sizes[-2]]
        nodes, triangles, before, after = ([each[k] for k in shown] for each in every)
        guess = [guesses["network for heat"][0][k] for k in shown]
        fields = {"temperature, K": [each[:, 0] for each in before]}
        fields["conductivity, m²/s"] = [each[:, 1] for each in before]
        fields |= {"exact": [each[:, 0] for each in after], "network": [g[:, 0] for g in guess]}
        fields["its error"] = [(g - a)[:, 0] for g, a in zip(guess, after, strict=True)]
        draw(asked.picture, (nodes, triangles), fields)
    return conclude(Comparison.of(results, "error/after/relative_l2"), small=asked.small)


if __name__ == "__main__":
    sys.exit(main())
