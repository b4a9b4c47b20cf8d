"""Many ships of one class: what they share, which one differs, and what changes in time."""
