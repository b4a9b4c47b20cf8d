"""What moves the ship: sequences of commands, their schedule, and the motion that follows."""
