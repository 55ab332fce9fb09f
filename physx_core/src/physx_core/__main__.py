"""``python -m physx_core`` is the command ``physx``."""

from physx_core.cli import main

raise SystemExit(main())
