"""Free runs against logs: fits, bands, comparisons."""
