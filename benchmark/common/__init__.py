"""What the experiments, the measurements and the reports share."""
