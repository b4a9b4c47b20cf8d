"""Which method, predictor and structure: choices that the data make, by held-out free runs."""
