"""Search for the most informative sequences: ascent, campaigns, multiple shooting, duration."""
