"""Training runs, turned into figures and records: development tools, not part of the installed package."""

from sb3_cgp.common.extras import require_from_extra

# Not all of the others come with rl_zoo3 where that was installed without the extra
for name in ("rl_zoo3", "matplotlib", "pandas", "rliable", "scipy", "tensorboard"):
    require_from_extra(name, "zoo", "The package benchmark")
