"""Whether to believe an estimate: tests, each with its null in words, and one verdict."""
