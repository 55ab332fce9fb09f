"""The result: values with intervals, in files, as text, on the page of a report."""
