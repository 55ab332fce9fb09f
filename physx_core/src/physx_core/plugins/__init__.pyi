"""Plugins: components of pip-installed packages, selected by the name of their entry point."""

from .hookspecs import KINDS as KINDS
from .hookspecs import Components as Components
from .hookspecs import hookimpl as hookimpl
from .hookspecs import is_component_name as is_component_name
from .references import find as find
from .references import import_component as import_component
from .references import import_module as import_module
from .references import reference_of as reference_of
from .references import resolve as resolve
from .registry import Plugin as Plugin
from .registry import PluginInfo as PluginInfo
from .registry import available as available
from .registry import load as load
