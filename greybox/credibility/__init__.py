"""Tests of an estimate, each with its null hypothesis in words, and one verdict."""
