"""Optimality criteria of the covariance, one a file."""
