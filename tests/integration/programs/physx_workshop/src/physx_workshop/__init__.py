"""A format, a protocol, an executor of trials, and a kind of component that is its own."""
