"""Numerical routines on arrays and expressions: nothing here knows of ships or logs."""
