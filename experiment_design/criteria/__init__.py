"""What a trial is designed for: numbers of its motion that are to be large, one a file."""
