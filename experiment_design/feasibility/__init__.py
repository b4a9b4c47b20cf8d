"""Feasibility of a trial: whether it can be run within its limits, and what to change if not."""
