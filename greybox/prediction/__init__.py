"""Standard manoeuvres predicted from an identified model, each value with its interval."""
