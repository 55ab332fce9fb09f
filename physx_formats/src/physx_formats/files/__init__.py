"""The file formats, each with what it reads and writes."""
