"""The files of a dataset: partitions, manifest, virtual index."""
