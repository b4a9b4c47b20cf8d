"""What is asked of a design, and the optimisation problem that follows from it."""
