"""What speaks for a cause: kinematics, held-out logs, and what a generic force does as well."""
