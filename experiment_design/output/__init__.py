"""A design and its forms: plan, page, trial sheet."""
