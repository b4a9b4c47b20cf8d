"""Logs of trials: reading, conditioning, checking."""
