"""Imports Rerun without its messages about lost connections, which `LiveWriter` reports itself."""

from __future__ import annotations

import os

if "RUST_LOG" not in os.environ:  # Rerun reads it only when it is imported
    os.environ["RUST_LOG"] = "warn,re_grpc_client=off,re_sdk=off"
    try:
        import rerun as rerun
    finally:
        del os.environ["RUST_LOG"]
