"""Modules that sweeps, measurements and reports share."""
