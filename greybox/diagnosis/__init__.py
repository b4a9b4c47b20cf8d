"""Diagnosis: what a simulation gets wrong, why, and what it gains to mend it."""
