"""The table of episodes after compaction: a record for each episode that counts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from physx_core.dataset.read.order.addresses import Addresses
from physx_core.dataset.read.order.order import Order
from physx_core.dataset.read.order.rewriting import records_at
from physx_core.dataset.read.reader import Reader
from physx_core.dataset.store.episode_table import mode_index
from physx_core.dataset.store.manifest import Mode, Partition, Partitions
from physx_core.dataset.write.writer import Writer
from physx_core.typing import Batch


def compacted_records(
    writer: Writer,
    reader: Reader,
    orders: Mapping[str, Order],
    partitions: Mapping[str, Sequence[Partition]],
) -> Batch:
    """Return the rows of the table, by field.

    Args:
        writer: Writes the dataset.
        reader: Reads the records.
        orders: The modes to compact, and the order of their rows; records of others stay.
        partitions: The partitions in which their rows will be, in order.
    """
    table = reader.table()
    others = ~np.isin(table["mode_index"], [mode_index(name) for name in orders])
    parts = [{name: column[others] for name, column in table.items()}]
    for name, order in orders.items():
        is_open = name not in writer.recorder.recorded
        addresses = Addresses(Mode({}, Partitions(partitions[name])))
        records = records_at(order, reader.orders.places(name), addresses, table, is_open=is_open)
        parts.append(records)
    return {name: np.concatenate([part[name] for part in parts]) for name in table}
