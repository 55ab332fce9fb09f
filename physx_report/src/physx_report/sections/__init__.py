"""The sections that each report has."""
