"""Training runs, turned into figures and records: development tools, not part of the installed package."""
