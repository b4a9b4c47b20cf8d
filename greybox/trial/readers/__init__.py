"""Readers of trial files, one file each; all return a `Recording` or a `TableFile`."""
