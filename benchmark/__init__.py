"""Training runs, turned into figures and records: development tools, not part of the installed package."""

from sb3_cgp.common.extras import require_from_extra

require_from_extra("rl_zoo3", "zoo", "The package benchmark")
