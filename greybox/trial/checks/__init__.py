"""What is wrong with a log, told by kinematics before any force model."""
