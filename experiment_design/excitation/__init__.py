"""Excitation: sequences of commands, their schedule, and the motion that follows."""
