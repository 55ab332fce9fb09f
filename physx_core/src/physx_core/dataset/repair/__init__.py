"""Recovery after crashes, verification, and repair."""
