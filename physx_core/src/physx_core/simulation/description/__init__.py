"""World descriptions: plain, picklable data from which every backend builds a simulation.

A value out of range is a `ConfigError` as soon as a description is created.
"""
