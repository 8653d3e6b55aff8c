"""What memory is left."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any


def free_memory(device: Any = None) -> float:
    """Bytes that can still be had on a torch device (None: in this machine's memory); infinite where nobody can say."""
    if device is not None and device.type != "cpu":
        import torch

        ask = getattr(torch.get_device_module(device), "mem_get_info", None)
        return ask(device)[0] if ask else math.inf
    info = Path("/proc/meminfo")
    lines = info.read_text().splitlines() if info.is_file() else []
    return next((int(line.split()[1]) * 1024 for line in lines if line.startswith("MemAvailable:")), math.inf)
