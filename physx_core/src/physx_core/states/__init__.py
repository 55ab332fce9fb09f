"""States: what has changed in an object since it was created, as plain values.

An object is the graph of what it holds. `Baseline` numbers that graph once, right after creation,
so that the same object in another process has the same numbers. A state has the new contents of
numbered objects, which are restored in place, and the objects that have been added since. It holds
no code, and restoring it runs none but the `restore` of objects that have a `snapshot` themselves.
"""

from __future__ import annotations

from physx_core.states.baseline import Baseline
from physx_core.states.kind import StateAdapter
from physx_core.states.kinds import as_lists

__all__ = ["Baseline", "StateAdapter", "as_lists"]
