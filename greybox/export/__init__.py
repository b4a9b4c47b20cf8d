"""The identified model where it is used: C, an FMU, CasADi, MATLAB, JSON. One file a target."""
