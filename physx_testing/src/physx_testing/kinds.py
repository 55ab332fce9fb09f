"""The checks of each kind of component, by name."""

from __future__ import annotations

import importlib
from collections.abc import Mapping

from physx_core import plugins
from physx_core.errors import UsageError
from physx_testing.subject import Check


def checks_of(kind: str) -> Mapping[str, Check]:
    """Return the checks of a kind of component by name; names are sentences about the component.

    Raises:
        UsageError: If no installed package has checks for this kind.
    """
    entries = plugins.find_entries(plugins.CHECKS).get(kind)
    if not entries:
        raise UsageError(
            f"No installed package has checks of a {kind}. A package brings them with an entry "
            f'point "{kind}" in the group "{plugins.CHECKS}", which names a module with CHECKS: '
            "sentences about the component, each with a function that takes a Subject."
        )
    checks: Mapping[str, Check] = importlib.import_module(entries[0].value).CHECKS
    return checks
