"""Numerical routines on arrays: nothing here knows of ships or logs."""
