"""Imports Rerun without its messages of lost connections, of which `LiveWriter` tells itself."""

from __future__ import annotations

import os

if "RUST_LOG" not in os.environ:  # Rerun reads it when it is imported, and only then
    os.environ["RUST_LOG"] = "warn,re_grpc_client=off,re_sdk=off"
    try:
        import rerun as rerun
    finally:
        del os.environ["RUST_LOG"]
