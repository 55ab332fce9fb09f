"""Pipelines: data generation, training and prediction, each a loop that a reader can see."""
