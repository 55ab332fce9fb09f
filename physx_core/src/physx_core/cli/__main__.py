"""Runs the command ``physx`` for ``python -m physx_core.cli``, as needed by ``torchrun -m``."""

from physx_core.cli import main

raise SystemExit(main())
