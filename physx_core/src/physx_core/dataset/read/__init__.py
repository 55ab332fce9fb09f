"""Reads rows and shuffled batches."""
