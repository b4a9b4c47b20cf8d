"""From raw signals to a log: mapping, time grid, resampling, derived channels, corrections."""
