"""Clock offsets, lever arm and heading bias, from the kinematics of all logs of a ship."""
