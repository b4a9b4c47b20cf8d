"""One file an estimator, each with its ``ENTRY`` in the registry."""
