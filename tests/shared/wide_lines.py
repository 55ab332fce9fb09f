"""Lines that are wider than a terminal although they could be broken."""

COLUMNS = 80


def wide_lines(text):
    """Return the lines of more than 80 columns that have more than one word."""
    return [line for line in text.splitlines() if len(line) > COLUMNS and len(line.split()) > 1]
