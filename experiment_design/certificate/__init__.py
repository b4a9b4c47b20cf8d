"""Upper bounds on the criterion of any sequence, and how close a design comes to them."""
