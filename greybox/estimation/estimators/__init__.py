"""Estimators, one file each, with an ``ENTRY`` for the registry."""
