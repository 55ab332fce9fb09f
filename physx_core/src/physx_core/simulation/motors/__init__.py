"""Motors, which turn commands into joint torques, the same on every engine.

A value out of range is a `ConfigError` as soon as a motor is described.
"""
