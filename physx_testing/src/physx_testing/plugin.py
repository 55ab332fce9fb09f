"""Checks all components of a plugin, or the one named by a reference."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from physx_core import plugins
from physx_core.config import NetworkConfig, to_plain
from physx_core.errors import ComponentNotFoundError, ReferenceFormError, UsageError
from physx_core.fields import Field
from physx_core.plugins import check_kind, find, kind_names
from physx_testing.report import Check, Report
from physx_testing.running import TIMEOUT, plain_options, run_checks

_WITH_NETWORK = ("optimization", "transformation")


def check_plugin(
    name: str,
    *,
    kind: str | None = None,
    arguments: Mapping[str, Any] | None = None,
    network: NetworkConfig | None = None,
    fields: Sequence[Field] = (),
    expected_failures: Mapping[str, str] | None = None,
    timeout: float = TIMEOUT,
) -> Iterator[Report]:
    """Check the components that a name refers to, one per step of the iterator.

    Args:
        name: Name of a plugin, all of whose components are checked, or a reference:
            ``"plugin/name"``, ``"package.module:Class"`` or ``"script.py:Class"``.
        kind: Kind of component to check; None: all that the name refers to.
        arguments: Constructor arguments, if the name refers to a single component.
        network: For optimizations and transformations, the network to check them with; None: one of
            the same plugin that can be created without arguments and names them as its default.
        fields: Fields of a network; empty: several shapes are tried.
        expected_failures: Names of checks that may fail, each with the reason.
        timeout: Time limit for each check, in s; a check that exceeds it fails.

    Raises:
        PluginNotFoundError: If the plugin is not installed.
        ComponentNotFoundError: If there is no such component.
        UsageError: If arguments are given but the name refers to several components.
    """
    found = _components(name, kind)
    if (arguments or expected_failures) and len(found) > 1:
        raise UsageError(
            f'Arguments and expected failures apply to one component, but "{name}" refers to '
            f"{', '.join(f'{each} {reference}' for each, reference in found)}: name one of them, "
            "and its kind if needed."
        )
    common = {"expected_failures": expected_failures, "timeout": timeout}
    return (
        _check(each, reference, arguments or {}, network, fields, common)
        for each, reference in found
    )


def _check(
    kind: str,
    reference: str,
    arguments: Mapping[str, Any],
    network: NetworkConfig | None,
    fields: Sequence[Field],
    common: Mapping[str, Any],
) -> Report:
    options = plain_options(fields=fields)
    if kind in _WITH_NETWORK:
        chosen = network or _network_of(kind, reference)
        if chosen is not None:
            options["network"] = to_plain(chosen)
        elif kind == "optimization":
            return Report(kind, reference, (_NO_NETWORK,))
    return run_checks(kind, reference, arguments, options=options, **common)


_NO_NETWORK = Check(
    "can be imported and created",
    "skipped",
    "it needs a network to train, with a loss and an optimizer if it has none of its own",
)


def _components(name: str, kind: str | None) -> list[tuple[str, str]]:
    """Return the kinds and references of the components that a name refers to."""
    kinds = kind_names() if kind is None else [plugins.find_kind(kind).name]
    if ":" in name:
        return [(_kind_of(name, kinds), name)]
    plugin_name, _, component = name.partition("/")
    offered = plugins.load(plugin_name).components
    found = [
        (each, f"{plugin_name}/{known}")
        for each in kinds
        for known in offered.get(each, {})
        if component in ("", known)
    ]
    if not found:
        all_names = [known for each in kinds for known in offered.get(each, {})]
        raise ComponentNotFoundError(
            kind or "component", component, f'Plugin "{plugin_name}"', all_names
        )
    return found


def _kind_of(reference: str, kinds: Sequence[str]) -> str:
    """Return the kind of a class, or of an instance such as a format, by its base class."""
    for kind in kinds:
        made = find(kind, reference)
        if isinstance(made, type) or not callable(made):
            try:
                check_kind(kind, reference, made)
            except ReferenceFormError:
                continue
            return kind
    if len(kinds) == 1:
        return kinds[0]
    raise ReferenceFormError(
        f'"{reference}" does not derive from a base class of components, so specify its kind: '
        f"{', '.join(kind_names())}."
    )


def _network_of(kind: str, reference: str) -> NetworkConfig | None:
    """Return a network of the same plugin that has a component as its default."""
    plugin_name, slash, _ = reference.partition("/")
    if not slash or ":" in reference:
        return None
    offered = plugins.load(plugin_name).components.get("network", {})
    for name in offered:
        network = f"{plugin_name}/{name}"
        made = find("network", network)
        if getattr(made, f"default_{kind}", "") == reference:
            try:
                made()
            except Exception:  # it needs arguments
                continue
            return NetworkConfig(network)
    return None
