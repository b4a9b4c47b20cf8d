"""Optimality criteria of the covariance, one file each."""
