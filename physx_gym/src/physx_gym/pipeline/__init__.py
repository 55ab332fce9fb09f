"""Pipelines of environments and layers, built from plain data."""
