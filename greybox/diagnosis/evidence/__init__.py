"""Evidence for a cause: kinematics, held-out logs, and comparison with a generic force."""
