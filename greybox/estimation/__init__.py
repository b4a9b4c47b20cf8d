"""Estimators, their covariance and their tests."""
