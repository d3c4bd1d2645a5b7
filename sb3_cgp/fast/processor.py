"""What is fast on this processor."""

from typing import Any

import torch as th


def is_intel() -> bool:
    """
    Return whether the processor is Intel's.

    :return: whether it is; False where PyTorch does not know
    """
    return "Intel" in _capabilities().get("cpu_name", "")


def multiplies_bfloat16_faster() -> bool:
    """
    Return whether the processor multiplies bfloat16 faster than float32.

    AVX-512 BF16 multiplies twice as fast on AMD's processors, and no faster on Intel's, which have AMX for this. Virtual
    machines may hide AMX.

    :return: whether it does
    """
    capabilities = _capabilities()
    return bool(capabilities.get("amx_bf16") or (capabilities.get("avx512_bf16") and not is_intel()))


def _capabilities() -> dict[str, Any]:
    # Older versions of PyTorch lack this function
    capabilities: dict[str, Any] = getattr(th.cpu, "get_capabilities", dict)()
    return capabilities
