"""Defects of a log, found by kinematics before any force model."""
