"""The files of a partition: their format, their writer, their reader, and what tells lost rows."""
