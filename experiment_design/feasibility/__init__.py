"""Whether a trial can be run at all, whether its limits hold, and what to change if not."""
