"""Upper bounds on what any sequence could reach, and how close a design comes to them."""
