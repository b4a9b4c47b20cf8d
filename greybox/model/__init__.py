"""Symbolic models: terms, structures, predictors, free runs."""
