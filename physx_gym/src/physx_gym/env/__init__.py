"""The base environment and the layers of a pipeline."""
