"""Sub-commands of the console script."""
