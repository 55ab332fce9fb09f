"""Reading rows and shuffled batches."""
