"""Monte Carlo studies over the engine."""
