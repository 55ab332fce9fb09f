"""Files of a dataset: partitions, manifest, virtual index."""
