"""Objectives of a design, computed from the motion and maximised, one file each."""
