"""The limits that a trial may have, one a file."""
