"""Read strategies: from memory, exactly shuffled from disk, or windowed from disk."""
