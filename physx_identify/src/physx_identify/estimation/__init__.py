"""Estimation: torques linear in the unknowns, noise, the fit, and tests of what is left."""
