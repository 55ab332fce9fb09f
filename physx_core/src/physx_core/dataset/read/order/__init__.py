"""Which rows of a mode count, and in which order, by the table of episodes."""
