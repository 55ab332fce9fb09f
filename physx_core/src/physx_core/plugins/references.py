"""References: names of components, and how they are resolved."""

from __future__ import annotations

import hashlib
import importlib
import importlib.util
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any, Literal, overload

from physx_core.config import SCRIPT_PREFIX
from physx_core.config import reference_of as reference_of
from physx_core.errors import (
    ComponentNotFoundError,
    PhysxError,
    PluginError,
    ReferenceFormError,
)
from physx_core.plugins.hookspecs import KINDS
from physx_core.plugins.registry import load

if TYPE_CHECKING:
    from physx_core.components import (
        Environment,
        Launcher,
        Network,
        Optimization,
        Transformation,
        Visualizer,
    )
    from physx_core.simulation import Backend


@overload
def resolve(kind: Literal["environment"], reference: Any) -> Callable[..., Environment]: ...
@overload
def resolve(kind: Literal["network"], reference: Any) -> Callable[..., Network]: ...
@overload
def resolve(kind: Literal["optimization"], reference: Any) -> Callable[..., Optimization]: ...
@overload
def resolve(kind: Literal["transformation"], reference: Any) -> Callable[..., Transformation]: ...
@overload
def resolve(kind: Literal["visualizer"], reference: Any) -> Callable[..., Visualizer]: ...
@overload
def resolve(kind: Literal["launcher"], reference: Any) -> Callable[..., Launcher]: ...
@overload
def resolve(kind: Literal["backend"], reference: Any) -> Backend: ...
@overload
def resolve(kind: str, reference: Any) -> Any: ...


def resolve(kind: str, reference: Any) -> Any:
    """Return the component that a reference names.

    Args:
        kind: ``environment``, ``network``, ``optimization``, ``transformation``, ``visualizer``,
            ``backend`` or ``launcher``.
        reference: ``"plugin/name"``; ``"plugin"`` where it has just one of the kind;
            ``"package.module:Class"``; ``"script.py:Class"``; or the class itself.

    Returns:
        The class or factory; for ``backend`` an instance of it, ready to build simulations.

    Raises:
        PluginNotFoundError: If the plugin is not installed.
        PluginError: If it is installed but broken.
        ComponentNotFoundError: If the plugin, module or script has no component of that name.
        ReferenceFormError: If the reference has none of the forms above.
    """
    if kind not in KINDS:
        raise ReferenceFormError(f'"{kind}" is not a kind of component: {", ".join(KINDS)}.')
    component = _find(kind, reference)
    return component() if kind == "backend" and isinstance(component, type) else component


def locate(kind: str, reference: Any) -> str:
    """Return the reference by which another process finds a component without reading metadata.

    Reading the metadata of all installed packages takes a good part of a client's start.

    Args:
        kind: See `resolve`.
        reference: See `resolve`.

    Returns:
        ``"package.module:Class"`` if possible; otherwise the reference's own text.

    Raises:
        UsageError: If it is a class that no other process can find.
    """
    text = reference_of(reference)
    if ":" in text:
        return text
    plugin_name, _, name = text.partition("/")
    try:
        components = load(plugin_name).components.get(kind, {})
        if not name and len(components) == 1:
            name = next(iter(components))
        component = components[name]
        place = reference_of(component)
        return place if place == component or _find(kind, place) is component else text
    except (PhysxError, LookupError, AttributeError):  # the other process reports the error
        return text


def import_component(kind: str, reference: str) -> Any:
    """Import the object named by ``"package.module:Class"`` or ``"script.py:Class"``.

    Args:
        kind: Kind of the object, for messages.
        reference: The object's name.

    Raises:
        ComponentNotFoundError: If the module or script has no object of that name.
    """
    place, _, name = reference.rpartition(":")
    return _attribute(kind, _module(kind, place), name, place)


def _find(kind: str, reference: Any) -> Any:
    if not isinstance(reference, str):
        if isinstance(reference, type):
            return reference
        raise ReferenceFormError(f"{reference!r} is neither a class nor a reference to one.")
    if ":" in reference:
        return import_component(kind, reference)
    plugin_name, _, name = reference.partition("/")
    if not plugin_name:
        raise ReferenceFormError(
            f'"{reference}" does not name a {kind}: give "plugin/name", "package.module:Class" '
            'or "script.py:Class".'
        )
    plugin = load(plugin_name)
    components = plugin.components.get(kind, {})
    if not name and len(components) == 1:
        name = next(iter(components))
    if name not in components:
        raise ComponentNotFoundError(kind, name, f'Plugin "{plugin_name}"', components)
    component = components[name]
    if not isinstance(component, str):
        return component
    try:
        place, _, attribute = component.rpartition(":")
        return getattr(importlib.import_module(place), attribute)
    except Exception as error:  # a plugin's own import may fail in any way
        text = f'Plugin "{plugin_name}" fails to import its {kind} "{name}": {error}'
        raise PluginError(plugin_name, text) from error


def _module(kind: str, place: str) -> ModuleType:
    if place.endswith(".py"):
        return _script(kind, Path(place))
    try:
        return importlib.import_module(place)
    except ModuleNotFoundError as error:
        if error.name is not None and (place == error.name or place.startswith(error.name + ".")):
            raise ComponentNotFoundError(kind, place, "Python's module path", []) from error
        raise


def _script(kind: str, path: Path) -> ModuleType:
    path = path.resolve()
    main = sys.modules.get("__main__")
    if main is not None and Path(getattr(main, "__file__", None) or ".").resolve() == path:
        return main
    digest = hashlib.sha1(str(path).encode(), usedforsecurity=False).hexdigest()[:12]
    name = f"{SCRIPT_PREFIX}{digest}"
    if name in sys.modules:
        return sys.modules[name]
    spec = importlib.util.spec_from_file_location(name, path)
    if not path.is_file() or spec is None or spec.loader is None:
        scripts = [file.name for file in path.parent.glob("*.py")]
        raise ComponentNotFoundError(kind, path.name, f"The folder {path.parent}", scripts)
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    sys.path.insert(0, str(path.parent))
    try:
        spec.loader.exec_module(module)
    except BaseException:
        del sys.modules[name]
        raise
    return module


def _attribute(kind: str, module: ModuleType, name: str, place: str) -> Any:
    found: Any = module
    for part in name.split("."):
        if not hasattr(found, part):
            raise ComponentNotFoundError(kind, name, place, _classes(kind, module))
        found = getattr(found, part)
    return found


def _classes(kind: str, module: ModuleType) -> list[str]:
    """Return the names of the classes of a module that may be meant by a reference."""
    from physx_core import components

    base = getattr(components, kind.capitalize(), None)
    classes = {name: found for name, found in vars(module).items() if isinstance(found, type)}
    if base is None:
        return list(classes)
    fitting = [name for name, found in classes.items() if issubclass(found, base) and found != base]
    if kind != "network":
        return fitting
    own = [name for name, found in classes.items() if found.__module__ == module.__name__]
    return list({*fitting, *own}) or list(classes)  # or a library's own
