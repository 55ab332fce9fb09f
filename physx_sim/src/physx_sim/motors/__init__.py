"""Motors that turn commands into joint torques, independent of the engine.

An out-of-range value raises `ConfigError` when the motor's description is created.
"""
