"""Plugins: components of pip-installed packages, selected by the name of their entry point."""

from .creation import create as create
from .creation import create_network as create_network
from .entries import CHECKS as CHECKS
from .entries import find_entries as find_entries
from .entries import official_package as official_package
from .hookspecs import Components as Components
from .hookspecs import hookimpl as hookimpl
from .hookspecs import is_component_name as is_component_name
from .hookspecs import kind_hook as kind_hook
from .kinds import Kind as Kind
from .kinds import find_kind as find_kind
from .kinds import kind_names as kind_names
from .references import check_kind as check_kind
from .references import complete_reference as complete_reference
from .references import find as find
from .references import import_component as import_component
from .references import import_module as import_module
from .references import reference_of as reference_of
from .references import references_of as references_of
from .references import resolve as resolve
from .references import resolve_all as resolve_all
from .registry import Plugin as Plugin
from .registry import PluginInfo as PluginInfo
from .registry import available as available
from .registry import load as load
