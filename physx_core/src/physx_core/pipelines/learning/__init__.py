"""What a training is made of: learner, batches, records, and resuming."""
