"""What both engines share: models, shapes, algorithms, and the common simulation."""
