"""Statistics, claims, figures and the results page of sweeps."""
