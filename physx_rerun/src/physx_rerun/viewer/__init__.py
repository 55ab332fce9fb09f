"""Viewer processes, and streams that write to them."""
