"""Layers of pipelines."""
