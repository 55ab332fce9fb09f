"""Entry point of a client that a server started: ``python -m physx_core.workers``."""

from __future__ import annotations

import argparse
import os
import sys

from physx_core import cells
from physx_core.errors import PhysxError
from physx_core.net.handshake import TOKEN_VARIABLE
from physx_core.processes import kill_descendants, prepare_worker
from physx_core.workers.client.worker import run_client
from physx_core.workers.warned import mark_warnings


def main() -> int:
    """Run a client with the command-line options; return its exit status."""
    parser = argparse.ArgumentParser(prog="python -m physx_core.workers", description=__doc__)
    parser.add_argument("--connect", metavar="HOST:PORT", required=True, help="the server")
    parser.add_argument("--instance", type=int, help="number of the instance; any by default")
    options = parser.parse_args()
    prepare_worker()
    mark_warnings()
    cells.take()
    token = os.environ.pop(TOKEN_VARIABLE, "")
    try:
        return run_client(options.connect, token, options.instance)
    except PhysxError as error:
        sys.stderr.write(f"physx client: {error}\n")
        return 1
    finally:
        kill_descendants()  # nothing else does if the server is gone too


if __name__ == "__main__":
    sys.exit(main())
