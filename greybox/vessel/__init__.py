"""What is known of a vessel: geometry, thrusters, limits, sensors, and its force."""
