"""Export, import and editing of the rows of a dataset."""
