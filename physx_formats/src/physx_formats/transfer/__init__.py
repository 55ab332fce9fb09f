"""What is done with the rows of a dataset: exported, imported, edited."""
