"""The engine DART."""
