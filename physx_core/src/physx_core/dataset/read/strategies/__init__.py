"""Read strategies: from memory, exactly shuffled from disk, or in windows from disk."""
