"""A model on its way: its step, how thrusters follow, and the compiled forms of a run."""
