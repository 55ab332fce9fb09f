"""The command ``physx``, whose subcommands are entry points that other packages can add.

A package adds a command with an entry point in the group ``physx.commands`` that names a module
with a function ``run(words)``. The first line of the module's docstring, after the colon, is the
command's summary in ``physx --help``. The commands ``report`` and ``view`` have a function ``show``
as well: see `physx_core.Result.show` and `physx_core.Dataset.show`.
"""

from __future__ import annotations

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
