"""Viewer processes and the streams that feed them."""
