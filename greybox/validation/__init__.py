"""Free runs against logs, comparisons, choices."""
