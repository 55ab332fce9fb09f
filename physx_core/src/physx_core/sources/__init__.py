"""Sources: where a pipeline's samples come from, all behind one interface."""
