"""What a motion tells of the parameters: information, covariances, and optimality criteria."""
