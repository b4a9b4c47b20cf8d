"""The request for a design, and the optimisation problem that follows from it."""
