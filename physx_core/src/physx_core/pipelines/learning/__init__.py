"""Parts of a training: learner, batches, records, and resuming."""
