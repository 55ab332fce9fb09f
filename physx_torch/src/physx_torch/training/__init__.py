"""Optimization, data-parallel training, and statistics."""
