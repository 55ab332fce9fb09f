"""References: names of components, and how they are resolved.

Users may name any code. Files may only name components of installed plugins, ``"plugin/name"``: see
`check_recorded`.
"""

from __future__ import annotations

import ast
import contextlib
import functools
import hashlib
import importlib
import importlib.util
import sys
import warnings
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any, Literal, overload

from physx_core.config import SCRIPT_PREFIX
from physx_core.config import reference_of as reference_of
from physx_core.errors import (
    ComponentNotFoundError,
    MissingLibraryError,
    PhysxError,
    PluginError,
    PluginNotFoundError,
    ReferenceFormError,
    UntrustedReferenceError,
    listed,
)
from physx_core.plugins.hookspecs import ADAPTER
from physx_core.plugins.kinds import find_kind, kind_names
from physx_core.plugins.loading import loading
from physx_core.plugins.methods import check_methods
from physx_core.plugins.registry import available, load, plugin_hint

if TYPE_CHECKING:
    from physx_core.components import (
        Buffer,
        Environment,
        Launcher,
        Network,
        Optimization,
        Sampler,
        Transformation,
        Visualizer,
    )

_MOST_VALUES = 10_000
"""Maximum number of values in the arguments of a component that a file names."""


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
def resolve(kind: Literal["buffer"], reference: Any) -> Callable[..., Buffer]: ...
@overload
def resolve(kind: Literal["sampler"], reference: Any) -> Callable[..., Sampler]: ...
@overload
def resolve(kind: str, reference: Any) -> Any: ...


def resolve(kind: str, reference: Any) -> Any:
    """Return the component that a reference names.

    Args:
        kind: A name of `kind_names`, such as ``environment``.
        reference: ``"plugin/name"``; ``"plugin"`` if it has only one component of the kind;
            ``"package.module:Class"``; ``"script.py:Class"``; either of them after ``"plugin/"``,
            for what that plugin adapts; or the class itself.

    Returns:
        The class or factory; an instance of it for a kind that says so, such as ``backend``.

    Raises:
        PluginNotFoundError: If the plugin is not installed.
        PluginError: If it is installed but broken.
        ComponentNotFoundError: If the plugin, module or script has no component of that name.
        ReferenceFormError: If the reference has none of the forms above, or names a class of
            another kind.
        ConfigError: If it is a class that lacks a method, or whose methods take other arguments.
    """
    component = find(kind, reference)
    check_component(kind, reference, component)
    return component() if find_kind(kind).is_instance and isinstance(component, type) else component


def references_of(kind: str) -> dict[str, list[str]]:
    """Return the components of a kind by name, each with its references ``"plugin/name"``.

    Broken plugins are left out; ``physx plugins`` shows their errors.
    """
    found: dict[str, list[str]] = {}
    for plugin in sorted(available()):
        with contextlib.suppress(PluginError):
            for name in load(plugin).components.get(kind, ()):
                found.setdefault(name, []).append(f"{plugin}/{name}")
    return found


def resolve_all(kind: str) -> dict[str, Any]:
    """Return all components of a kind by reference; a broken one is left out, with a warning.

    Args:
        kind: See `resolve`.
    """
    found = {}
    for reference in (each for places in references_of(kind).values() for each in places):
        try:
            found[reference] = resolve(kind, reference)
        except MissingLibraryError:  # it would say so if it were asked for
            continue
        except PhysxError as error:
            warnings.warn(f"The {kind} {reference} is left out. {error}", stacklevel=2)
    return found


def complete_reference(kind: str, name: Any) -> Any:
    """Return the reference of a component named alone, such as ``formats/npz`` for ``npz``.

    Args:
        kind: See `resolve`.
        name: The name; what is a reference already is returned unchanged.

    Raises:
        ComponentNotFoundError: If no plugin has a component of that name.
        ReferenceFormError: If several have one.
    """
    if not isinstance(name, str) or ":" in name or "/" in name:
        return name
    known = references_of(kind)
    if name not in known:
        raise ComponentNotFoundError(kind, name, "physx", known)
    if len(known[name]) > 1:
        raise ReferenceFormError(f'"{name}" may be {" or ".join(known[name])}: give one of these.')
    return known[name][0]


def locate(kind: str, reference: Any) -> str:
    """Return a reference with which another process finds a component without reading metadata.

    Reading the metadata of all installed packages is a large part of a client's startup time.

    Args:
        kind: See `resolve`.
        reference: See `resolve`.

    Returns:
        ``"package.module:Class"`` if possible; otherwise the reference's text.

    Raises:
        UsageError: If it is a class that other processes cannot find.
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
        return place if place == component or find(kind, place) is component else text
    except (PhysxError, LookupError, AttributeError):  # the other process reports the error
        return text


def import_component(kind: str, reference: str) -> Any:
    """Import the object named by ``"package.module:Class"`` or ``"script.py:Class"``.

    Args:
        kind: Kind of the object, for messages.
        reference: The object's name.

    Raises:
        ComponentNotFoundError: If the module or script has no object of that name.
        ReferenceFormError: If the object belongs to Python's standard library, which has no
            components.
    """
    place, _, name = reference.rpartition(":")
    found = _attribute(kind, import_module(kind, place), name, place)
    if _is_standard(found):
        raise ReferenceFormError(
            f'"{reference}" belongs to Python\'s standard library and is not a physx {kind}.'
        )
    return found


def _is_standard(found: Any) -> bool:
    while isinstance(found, functools.partial):
        found = found.func
    module = getattr(found, "__module__", None) or type(found).__module__
    return str(module).partition(".")[0] in sys.stdlib_module_names


def check_kind(kind: str, reference: Any, found: Any) -> None:
    """Check that a reference names a class of the right kind, or a function, before calling it.

    Args:
        kind: See `resolve`.
        reference: The reference, for messages.
        found: The object that it names.

    Raises:
        ReferenceFormError: If it names anything else.
    """
    base = base_of(kind)
    if isinstance(found, type) and not issubclass(found, base):
        place = _place_of(reference)
        raise ReferenceFormError(
            f'"{place}" is a class that is not derived from {base.__name__}, so it is not a physx '
            f"{kind}.{adapters_hint(kind, place)}"
        )
    if not callable(found) and not isinstance(found, base):
        raise ReferenceFormError(
            f'"{reference}" is a {type(found).__name__}, which is not a physx {kind}.'
        )


def check_component(kind: str, reference: Any, found: Any) -> None:
    """Check that a reference names a class of the right kind that is complete, or a function.

    Args:
        kind: See `resolve`.
        reference: The reference, for messages.
        found: The object that it names.

    Raises:
        ReferenceFormError: If it names anything else.
        ConfigError: If it is a class that lacks a method, or whose methods take other arguments.
    """
    check_kind(kind, reference, found)
    check_methods(kind, reference, found, base_of(kind))


def base_of(kind: str) -> type[Any]:
    """Return the base class of a kind of component."""
    place, _, name = find_kind(kind).base.rpartition(":")
    base: type[Any] = getattr(importlib.import_module(place), name)
    return base


# References in files ------------------------------------------------------------------------


def check_recorded(
    kind: str, file: object, reference: Any, arguments: Any, advice: str, *, trust: bool
) -> None:
    """Check that a file names only components of installed plugins, in arguments as well.

    Any string with a colon may name code, as in ``"module:Class"``.

    Args:
        kind: Kind of the component.
        file: Path of the file.
        reference: The reference in the file; None: the user named the component.
        arguments: The component's keyword arguments in the file.
        advice: How the user can name the component instead.
        trust: Whether the user trusts the file, which may then also name classes.

    Raises:
        UntrustedReferenceError: If it names anything else.
    """
    if trust:
        is_code = isinstance(reference, str) and ":" in reference
        if is_code and not _names_class(kind, reference):
            raise UntrustedReferenceError(
                f'{file} names "{reference}", which is not a class. Functions are not taken from '
                f"a file, even if you trust it. Name it yourself: {advice}."
            )
        return
    if is_of_plugin(kind, reference):
        reference = None
    for where, text in _texts(file, (kind, reference), (f"{kind}_kwargs", arguments)):
        if ":" in text:
            raise UntrustedReferenceError(
                f'{file} has {where} = "{text:.200}", which may be any code. A file may only name '
                'components of installed plugins, such as "plugin/name". If you know this one, '
                f"name it yourself: {advice}. If you trust everything that the file names, use "
                "--trust (in Python trust=True)."
            )


def _names_class(kind: str, reference: str) -> bool:
    """Return whether ``"module:Class"`` names a class; after ``"plugin/"``, also an id."""
    adapted = _adapted(kind, reference)
    if adapted is None:
        return isinstance(find(kind, reference), type)
    named: str = adapted.keywords[ADAPTER]
    is_id = not all(part.isidentifier() for part in named.rpartition(":")[2].split("."))
    return is_id or isinstance(import_component(kind, named), type)


def is_of_plugin(kind: str, reference: Any) -> bool:
    """Return whether a reference names the class of an installed plugin's component."""
    package = str(reference).partition(":")[0].partition(".")[0]
    for name, info in available().items():
        if info.module.partition(".")[0] == package:
            components = load(name).components.get(kind, {}).values()
            if reference in map(_place_of, components):
                return True
    return False


def _texts(file: object, *values: tuple[str, Any]) -> Iterator[tuple[str, str]]:
    """Yield all strings in nested plain data, each with its location."""
    left = list(values)
    for _ in range(_MOST_VALUES):
        if not left:
            return
        where, value = left.pop()
        if isinstance(value, str):
            yield where, value
        elif isinstance(value, Mapping):
            left += [(f"{where}.{key}", item) for key, item in value.items()]
        elif isinstance(value, (list, tuple)):
            left += [(where, item) for item in value]
    raise UntrustedReferenceError(
        f"{file} has more than {_MOST_VALUES} values in {values[-1][0]}. If this is intended, use "
        "--trust (in Python trust=True)."
    )


def is_recorded_as(given: Any, recorded: Any) -> bool:
    """Return whether the component that the user named is the one that a file names.

    Scripts and modules may have moved, so only the class of ``"module:Class"`` is compared.
    """
    texts = [_place_of(given), _place_of(recorded)]
    if not all(":" in text for text in texts):
        return texts[0] == texts[1]
    return texts[0].rpartition(":")[2] == texts[1].rpartition(":")[2]


def _place_of(component: Any) -> str:
    if isinstance(component, type):
        return f"{component.__module__}:{component.__qualname__}"
    return str(component)


def find(kind: str, reference: Any) -> Any:
    """Return the object that a reference names, whatever its type; see `resolve`.

    Raises:
        PluginNotFoundError: If the plugin is not installed.
        PluginError: If it is installed but broken.
        ComponentNotFoundError: If the plugin, module or script has no component of that name.
        ReferenceFormError: If the kind is unknown, or the reference has none of the forms.
    """
    find_kind(kind)
    if not isinstance(reference, str):
        if isinstance(reference, type):
            return reference
        raise ReferenceFormError(f"{reference!r} is neither a class nor a reference to one.")
    if ":" in reference:
        adapted = _adapted(kind, reference)
        return import_component(kind, reference) if adapted is None else adapted
    if reference.endswith(".py"):
        raise ReferenceFormError(
            f'"{reference}" names a script, but not the {kind} in it: '
            f"give {_listed_classes(reference)}."
        )
    return _component_of_plugin(kind, reference)


def _adapted(kind: str, reference: str) -> Any:
    """Return what a plugin makes of ``"plugin/module:Name"``; None for other references.

    A script in a folder with the name of a plugin goes first: the user sees it.
    """
    plugin_name, slash, named = reference.partition("/")
    is_script = Path(reference.rpartition(":")[0]).is_file()
    if not slash or is_script or plugin_name not in available():
        return None
    components = load(plugin_name).components.get(kind, {})
    if ADAPTER not in components:
        raise ComponentNotFoundError(kind, named, f'Plugin "{plugin_name}"', components)
    make = _component_of_plugin(kind, f"{plugin_name}/{ADAPTER}")
    return functools.partial(make, **{ADAPTER: named})


def adapters_hint(kind: str, place: object) -> str:
    """Return advice for a class or function of another library, if plugins adapt such ones.

    Args:
        kind: See `resolve`.
        place: ``"package.module:Name"`` or ``"script.py:Name"``.
    """
    having: list[str] = []
    if not isinstance(place, str) or ":" not in place or place.partition("/")[0] in available():
        return ""
    for name in sorted(available()):
        with contextlib.suppress(PluginError):  # `physx plugins` shows the error
            if ADAPTER in load(name).components.get(kind, {}):
                having.append(f'"{name}/{place}"')
    return f" If it is of a plugin's library, give {' or '.join(having)}." if having else ""


def _component_of_plugin(kind: str, reference: str) -> Any:
    plugin_name, _, name = reference.partition("/")
    if not plugin_name:
        raise ReferenceFormError(
            f'"{reference}" names no {kind}: give "plugin/name", "package.module:Class" '
            'or "script.py:Class".'
        )
    if plugin_name not in available():
        raise _no_plugin(kind, plugin_name)
    components = load(plugin_name).components.get(kind, {})
    if not name and len(components) == 1:
        name = next(iter(components))
    if name not in components:
        raise ComponentNotFoundError(kind, name, f'Plugin "{plugin_name}"', components)
    component = components[name]
    if not isinstance(component, str):
        return component
    with loading(plugin_name, f'Plugin "{plugin_name}"', f'fails to import its {kind} "{name}"'):
        place, _, attribute = component.rpartition(":")
        return getattr(importlib.import_module(place), attribute)


def _listed_classes(script: str) -> str:
    """Return references to a script's classes that have a base class, without running it."""
    names = ["Class"]
    with contextlib.suppress(OSError, SyntaxError, ValueError):
        tree = ast.parse(Path(script).read_bytes())
        classes = (node for node in tree.body if isinstance(node, ast.ClassDef))
        names = [node.name for node in classes if node.bases] or names
    return " or ".join(f'"{script}:{name}"' for name in names)


def _no_plugin(kind: str, plugin_name: str) -> PluginNotFoundError:
    """Return the error for a plugin that is not installed, with suggestions."""
    having, meant = [], []
    for name in sorted(available()):
        with contextlib.suppress(PluginError):  # `physx plugins` shows the error
            components = load(name).components.get(kind, {})
            having += [name] if components else []
            meant += [f'"{name}/{plugin_name}"'] if plugin_name in components else []
    hint = f"Plugins with a component of kind {kind}: {listed(having)}. {plugin_hint(plugin_name)}"
    return PluginNotFoundError(plugin_name, list(available()), "" if meant else hint, meant)


def import_module(kind: str, place: str) -> ModuleType:
    """Import a module that the user names, or a script.

    A module that Python does not find is looked for in the working directory, which is then on the
    module path, as the folder of a script is. It is not put there before: metadata and modules in a
    folder in which a command happens to run must not become plugins or replace libraries.

    Args:
        kind: Kind of the component that is wanted from it, for messages.
        place: ``"package.module"`` or ``"folder/script.py"``.

    Raises:
        ComponentNotFoundError: If there is no such module or script.
    """
    if place.endswith(".py"):
        return _script(kind, Path(place))
    try:
        return importlib.import_module(place)
    except ModuleNotFoundError as error:
        is_missing = error.name is not None and f"{place}.".startswith(f"{error.name}.")
        if is_missing and _adds_working_directory(place):
            return import_module(kind, place)
        if is_missing:
            hint = (
                "Install the package that has this module, set PYTHONPATH, or run where the module "
                "is."
            )
            raise ComponentNotFoundError(kind, place, "Python's module path", [], hint) from error
        raise


def _adds_working_directory(place: str) -> bool:
    """Put the working directory on the module path if it has the module and is not there yet."""
    top, here = place.partition(".")[0], str(Path.cwd())
    there = Path(f"{top}.py").is_file() or Path(top).is_dir()
    if not there or here in sys.path:
        return False
    sys.path.insert(0, here)
    importlib.invalidate_caches()
    return True


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
            known, hint = _classes(kind, module), ""
            if not known or not name.isidentifier():
                hint = f"It has: {listed(known)}.{adapters_hint(kind, f'{place}:{name}')}"
            raise ComponentNotFoundError(kind, name, place, known, hint)
        found = getattr(found, part)
    return found


def _classes(kind: str, module: ModuleType) -> list[str]:
    """Return the names of a module's classes that a reference may have meant."""
    classes = {name: found for name, found in vars(module).items() if isinstance(found, type)}
    if kind not in kind_names():
        return list(classes)
    base = base_of(kind)
    fitting = [name for name, found in classes.items() if issubclass(found, base) and found != base]
    if kind != "network":
        return fitting
    own = [name for name, found in classes.items() if found.__module__ == module.__name__]
    return list({*fitting, *own}) or list(classes)  # or a library's own
