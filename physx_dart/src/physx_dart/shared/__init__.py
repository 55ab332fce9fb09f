"""Models, shapes, algorithms, and the simulation that both engines share."""
