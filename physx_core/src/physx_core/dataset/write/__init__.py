"""Appending, updating, and merging rows."""
