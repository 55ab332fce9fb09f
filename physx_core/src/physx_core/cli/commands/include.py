"""``physx include``: print the folder of physx.h, physx.f90 and physx.py, for other programs."""

from __future__ import annotations

from collections.abc import Sequence

from physx_core.errors import UsageError
from physx_core.external import INCLUDE


def run(words: Sequence[str]) -> None:
    """Print the folder."""
    if words and words[0] in ("-h", "--help"):
        print(
            "usage: physx include\n\nPrints the include folder for compiling programs, as in\n"
            '  cc -I"$(physx include)" heat.c -o heat'
        )
        return
    if words:
        raise UsageError(f"physx include takes no options, not {' '.join(words)}.")
    print(INCLUDE)
