"""The networks that the plugin brings."""
