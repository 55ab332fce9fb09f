"""Access to the rows of a field, in memory, mapped, or on disk: only the speed depends on it."""
