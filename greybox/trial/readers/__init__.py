"""Readers of foreign formats: one file in, one `Recording` out, nothing judged."""
