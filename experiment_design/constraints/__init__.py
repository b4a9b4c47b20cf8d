"""The limits of a trial, as plain data and as compiled functions."""
