"""Resuming a stopped training, to the bit, for any of SB3's off-policy algorithms."""
