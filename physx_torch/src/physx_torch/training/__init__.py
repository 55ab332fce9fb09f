"""Optimization, data loading and statistics."""
