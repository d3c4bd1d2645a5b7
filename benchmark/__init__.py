"""Training runs, turned into figures and records: development tools, not part of the installed package."""

import importlib.util
import sys

# Commands that do without the extra, on a machine that is lent for a short time
BARE = ("benchmark.gpu_list", "benchmark.population")

# `python -m` imports the package before it knows the command
if not any(option == "-m" and module in BARE for option, module in zip(sys.orig_argv, sys.orig_argv[1:], strict=False)):
    # Not all of the others come with rl_zoo3 where that was installed without the extra
    missing = [
        name
        for name in ("rl_zoo3", "matplotlib", "pandas", "rliable", "scipy", "tensorboard")
        if importlib.util.find_spec(name) is None
    ]
    if missing:
        # PyTorch, which the package imports, takes seconds
        from sb3_cgp.common.extras import require_from_extra

        require_from_extra(missing[0], "zoo", "The package benchmark")
