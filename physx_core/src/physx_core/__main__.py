"""Runs the command ``physx`` for ``python -m physx_core``."""

from physx_core.cli import main

raise SystemExit(main())
