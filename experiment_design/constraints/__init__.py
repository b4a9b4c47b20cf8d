"""What a trial must keep, as plain data and as compiled functions."""
