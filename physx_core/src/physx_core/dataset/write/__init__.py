"""Appends, updates and merges rows."""
