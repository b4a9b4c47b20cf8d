"""The information of a motion on the parameters, covariances, and optimality criteria."""
