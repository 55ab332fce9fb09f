"""``python -m physx_core.cli`` is the command ``physx``, as ``torchrun -m`` needs it."""

from physx_core.cli import main

raise SystemExit(main())
