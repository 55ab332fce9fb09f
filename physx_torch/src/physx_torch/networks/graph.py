"""GraphNetwork: messages along the edges of graphs or meshes of any size."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import torch

from physx_core import Field
from physx_core.errors import ConfigError, FieldsMismatchError
from physx_core.fields import BATCH
from physx_torch.choices import make_activation
from physx_torch.networks.network import TorchNetwork, reject_complex


class GraphNetwork(TorchNetwork):
    """Encodes nodes and edges, passes messages along the edges, and decodes the nodes.

    Of `net_fields`, the one with `Field.indexes` has the edges, shape (edge, 2), from the first
    node to the second one; those with the axis that it indexes are values of the nodes, others with
    its own axis those of the edges, and fields without a free axis belong to all nodes of a sample.
    An edge also knows by how much the values of its nodes differ. `opt_fields` belong to the nodes.
    Edges count in the direction in which they are stored; with `both_ways` in the other one as
    well.

    Attributes:
        sizes: Numbers of values of a node, of an edge, and of a node's prediction.
    """

    def __init__(
        self,
        nodes: int,
        outputs: int,
        *,
        edges: int = 0,
        hidden: int = 64,
        steps: int = 4,
        both_ways: bool = True,
        activation: str | type[torch.nn.Module] = "SiLU",
        **fields: Any,
    ) -> None:
        """Create the layers.

        Args:
            nodes: Number of values of a node, with those that belong to all nodes of a sample.
            outputs: Number of predicted values of a node.
            edges: Number of values of an edge.
            hidden: Number of neurons of each layer.
            steps: How many times messages are passed.
            both_ways: Whether messages also go from the second node of an edge to the first one.
            activation: Class of an activation, or its name in `torch.nn`.
            fields: ``net_fields``, ``opt_fields`` and ``pred_fields`` as in `TorchNetwork`.

        Raises:
            ConfigError: If a number is not positive, or there is no such activation.
        """
        super().__init__(**fields)
        numbers = {"nodes": nodes, "outputs": outputs, "hidden": hidden, "steps": steps}
        for name, number in numbers.items():
            if type(number) is not int or number < 1:
                raise ConfigError(f"GraphNetwork.{name} is {number!r} but must be positive.")
        if type(edges) is not int or edges < 0:
            raise ConfigError(f"GraphNetwork.edges is {edges!r} but must not be negative.")
        self.sizes = nodes, edges, outputs
        self._both_ways = both_ways

        def layers(inputs: int, outputs: int) -> torch.nn.Sequential:
            return torch.nn.Sequential(
                torch.nn.Linear(inputs, hidden),
                make_activation("GraphNetwork.activation", activation, hidden),
                torch.nn.Linear(hidden, outputs),
            )

        self.encode_nodes = layers(nodes, hidden)
        self.encode_edges = layers(nodes + edges, hidden)
        self.messages = torch.nn.ModuleList(layers(3 * hidden, hidden) for _ in range(steps))
        self.updates = torch.nn.ModuleList(layers(2 * hidden, hidden) for _ in range(steps))
        self.norms = torch.nn.ModuleList(torch.nn.LayerNorm(hidden) for _ in range(2 * steps))
        self.decode = layers(hidden, outputs)
        self._parts: dict[str, str] = {}
        self._shapes: list[tuple[int, ...]] = []

    def bind(self, fields: Mapping[str, Field]) -> None:
        """Find out what the fields are.

        Raises:
            FieldsMismatchError: If there are no edges, a field belongs to neither nodes nor edges,
                or the numbers of values are others.
        """
        given = [name for name in self.net_fields if not name.endswith(BATCH)]
        indexing = [n for n in given if n in fields and fields[n].indexes and fields[n].free_axis]
        if len(indexing) != 1 or fields[indexing[0]].entry_shape != (2,):
            text = f'are {indexing or "none"}: one field of shape ("edge", 2) must index the nodes'
            raise FieldsMismatchError(f"{type(self).__name__} needs edges", {"edges": text})
        edges = fields[indexing[0]]
        self.net_fields = (*given, edges.indexes + BATCH)
        super().bind(fields)
        reject_complex(self, fields)
        kinds = {edges.indexes: "node", edges.free_axis: "edge", "": "sample"}
        self._parts, counts = {}, {"node": 0, "edge": 0, "sample": 0}
        for name in given:
            part = "edges" if name == edges.name else kinds.get(fields[name].free_axis, "")
            if not part:
                text = f"shape {fields[name].shape}, on neither nodes nor edges"
                raise FieldsMismatchError(f"{type(self).__name__} does not fit", {name: text})
            self._parts[name] = part
            if part != "edges":
                counts[part] += math.prod(fields[name].entry_shape)
        targets = {name: fields[name] for name in self.opt_fields}
        wrong = {
            n: f"shape {of.shape}" for n, of in targets.items() if of.free_axis != edges.indexes
        }
        if wrong:
            raise FieldsMismatchError(f"{type(self).__name__} predicts values of nodes", wrong)
        self._shapes = [of.entry_shape for of in targets.values()]
        outputs = sum(map(math.prod, self._shapes))
        found = counts["node"] + counts["sample"], counts["edge"], outputs
        for option, own, value in zip(
            ("nodes", "edges", "outputs"), self.sizes, found, strict=True
        ):
            if own != value:
                text = f"is {own}, but the fields have {value} values"
                raise FieldsMismatchError(f"{type(self).__name__} does not fit", {option: text})

    def forward(self, *inputs: torch.Tensor) -> torch.Tensor | list[torch.Tensor]:
        """Return the predictions of the nodes for packed tensors of `net_fields`.

        Args:
            inputs: One tensor for each field, of shape (entries, *shape of an entry), of a field
                without a free axis (samples, *field shape); the sample of each node last.
        """
        *values, of = inputs
        parts: dict[str, list[torch.Tensor]] = {"node": [], "edge": []}
        for tensor, part in zip(values, self._parts.values(), strict=True):
            if part == "edges":
                edges = tensor
                continue
            flat = tensor.to(self.data_type).reshape(len(tensor), -1)
            if part == "sample":
                flat, part = flat[of], "node"
            parts[part].append(flat)
        node = torch.cat(parts["node"], 1)
        known = torch.cat(parts["edge"], 1) if parts["edge"] else node.new_zeros(len(edges), 0)
        first, second = edges[:, 0], edges[:, 1]
        if self._both_ways:
            first, second = torch.cat([first, second]), torch.cat([second, first])
            known = torch.cat([known, known])
        edge = self.encode_edges(torch.cat([node[second] - node[first], known], 1))
        hidden = self.encode_nodes(node)
        count = hidden.new_zeros(len(hidden)).index_add_(
            0, second, hidden.new_ones(len(second))
        ).clamp_(min=1)  # fmt: skip
        norms = iter(self.norms)
        for message, update in zip(self.messages, self.updates, strict=True):
            sent = next(norms)(message(torch.cat([hidden[first], hidden[second], edge], 1)))
            edge = edge + sent
            mean = torch.zeros_like(hidden).index_add_(0, second, edge) / count[:, None]
            hidden = hidden + next(norms)(update(torch.cat([hidden, mean], 1)))
        output = self.decode(hidden)
        sizes = [math.prod(shape) for shape in self._shapes]
        found = [
            part.reshape(len(part), *shape)
            for part, shape in zip(output.split(sizes, 1), self._shapes, strict=True)
        ]
        return found[0] if len(found) == 1 else found
