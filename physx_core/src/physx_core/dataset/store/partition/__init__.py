"""The files of a partition: format, writer, reader, and detection of lost rows."""
