"""The interfaces that plugins implement and pipelines rely on."""
