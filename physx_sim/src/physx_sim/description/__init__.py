"""World descriptions: plain, picklable data from which every backend builds a simulation.

An out-of-range value raises `ConfigError` when the description is created.
"""
