"""What a run ran on: the machine, the versions of what it used, and how much memory it took."""

from __future__ import annotations

import importlib.metadata
import os
import platform
import sys
from pathlib import Path
from typing import Any

import torch

USED = ("torch", "lightning", "numpy", "numba", "opencv-contrib-python-headless", "diffusers", "transformers", "gsplat")
MANIFEST = Path(__file__).resolve().parents[3] / "extension.yaml"


def versions() -> dict[str, str]:
    """This extension's version, Python's, and those of the packages that results may depend on, where installed."""
    found = {"python": platform.python_version()}
    if MANIFEST.is_file():
        import yaml

        manifest = yaml.safe_load(MANIFEST.read_text(encoding="utf-8"))
        found = {manifest["name"]: str(manifest["version"]), **found}
    for name in USED:
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            continue
    return found


def machine(device: torch.device) -> dict[str, Any]:
    """The computer and the device of the run."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    found = {"system": platform.platform(), "processor": _processor(), "cores": cores}
    found |= {"threads of torch": torch.get_num_threads(), "device": str(device)}
    if device.type != "cpu":
        found["accelerator"] = str(torch.get_device_module(device).get_device_name(device))
    return found


def _processor() -> str:
    info = Path("/proc/cpuinfo")
    lines = info.read_text(encoding="utf-8").splitlines() if info.is_file() else []
    named = (line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    return next(named, platform.processor() or platform.machine())


def peak_memory(device: torch.device) -> float | None:
    """The most memory that this process had so far, MiB: on an accelerator what tensors took there, else all of the
    process. None on a system that does not say."""
    if device.type != "cpu":
        return torch.get_device_module(device).max_memory_allocated(device) / 2**20
    try:
        import resource
    except ModuleNotFoundError:  # Windows
        return None
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / (2**20 if sys.platform == "darwin" else 2**10)


def waiter(device: torch.device) -> Any:
    """A function that waits until the device has done all that it was asked for; None for the CPU, which has."""
    return None if device.type == "cpu" else lambda: torch.get_device_module(device).synchronize(device)
