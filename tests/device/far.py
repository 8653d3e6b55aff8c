"""A device that is not the CPU's, on a machine that has none: tensors say that they are elsewhere, operations follow.

Every far tensor wraps one of the CPU. `FarDevice`, a dispatch mode, sees every operation below autograd, carries it out
on what is wrapped, and refuses what CUDA refuses: operands on two devices (a CPU tensor without dimensions may take
part in what is done element by element, as there) and a generator of another device. Types are compared by the
operation itself. It counts what makes a GPU's caller wait: numbers and tensors that are fetched, results whose size is
not known before (nonzero, boolean indexing), index tensors that are sent along. What far tensors call their device is
"meta", which torch knows everywhere and for which it needs no driver; a tensor that is truly of that device, and holds
nothing, is an error.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, nullcontext
from importlib import import_module
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode, return_and_correct_aliasing

FAR = torch.device("meta")
aten = torch.ops.aten
COPIES = {aten._to_copy, aten.copy_, aten.copy}
NUMBERS = {aten._local_scalar_dense, aten.equal, aten.is_nonzero}
INDEXED = {aten.index, aten.index_put, aten.index_put_, aten._index_put_impl_}
SIZES = {aten.nonzero, aten.masked_select, aten._unique2, aten.unique_dim, aten.unique_consecutive}


class DeviceError(RuntimeError):
    """What would have failed on a GPU."""


class Far(torch.Tensor):
    """A tensor elsewhere. near: the tensor of the CPU that holds its numbers."""

    near: torch.Tensor
    __torch_function__ = torch._C._disabled_torch_function_impl

    @staticmethod
    def __new__(cls, near: torch.Tensor) -> Far:
        far = torch.Tensor._make_wrapper_subclass(
            cls,
            near.shape,
            strides=near.stride(),
            storage_offset=near.storage_offset(),
            dtype=near.dtype,
            device=FAR,
        )
        far.near = near
        return far

    @classmethod
    def __torch_dispatch__(cls, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        raise DeviceError(f"{func}: a far tensor outlived its device")

    def tolist(self) -> Any:
        return self.cpu().tolist()

    def __repr__(self, **_: Any) -> str:
        return f"Far({tuple(self.shape)}, {self.dtype})"


def near(value: Any) -> Any:
    """What a far tensor wraps; anything else as it is."""
    return value.near if isinstance(value, Far) else value


def away(value: Any) -> Any:
    """A tensor as a far one; anything else as it is."""
    return Far(value) if isinstance(value, torch.Tensor) else value


def each(function: Callable[[Any], Any], value: Any) -> Any:
    """What operations take and return (lists and tuples of values at most), with `function` of each value in it."""
    if isinstance(value, (tuple, list)):
        return type(value)([each(function, part) for part in value])
    return function(value)


def leaves(values: Iterable[Any]) -> Iterator[Any]:
    """The values in nested lists and tuples."""
    for value in values:
        if isinstance(value, (tuple, list)):
            yield from leaves(value)
        else:
            yield value


class Makers(TorchFunctionMode):
    """What makes tensors of Python's numbers above where a dispatch mode looks: on the CPU here, and then sent."""

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = dict(kwargs or {})
        if func in (torch.tensor, torch.as_tensor, torch.asarray) and is_far(kwargs.get("device")):
            del kwargs["device"]
            return func(*args, **kwargs).to(FAR)
        if func is torch.Tensor.new_tensor and isinstance(args[0], Far) and kwargs.get("device") is None:
            kwargs.setdefault("dtype", args[0].dtype)
            return torch.tensor(*args[1:], **kwargs).to(FAR)
        if func in (torch.Tensor.__getitem__, torch.Tensor.__setitem__) and isinstance(args[0], Far):
            index = args[1] if isinstance(args[1], tuple) else (args[1],)
            index = tuple(torch.tensor(part) if isinstance(part, list) else part for part in index)
            args = (args[0], index, *args[2:])
        return func(*args, **kwargs)


def is_far(device: Any) -> bool:
    """Whether what is asked for is the far device."""
    return device is not None and torch.device(device).type == FAR.type


class FarDevice(TorchDispatchMode):
    """While it is entered, device "meta" is one that computes. waits: how often its caller waited for it, by reason."""

    def __init__(self) -> None:
        super().__init__()
        self.waits: Counter[str] = Counter()
        self.operations = 0
        self._counting = True
        self._makers = Makers()

    def __enter__(self) -> FarDevice:
        self._makers.__enter__()
        return super().__enter__()

    def __exit__(self, *exception: Any) -> None:
        super().__exit__(*exception)
        self._makers.__exit__(*exception)

    @contextmanager
    def inside_a_kernel(self) -> Iterator[None]:
        """What happens in here stands for one kernel of the device: nothing is counted."""
        before, self._counting = self._counting, False
        try:
            yield
        finally:
            self._counting = before

    def kernel(self, function: Callable) -> Callable:
        """`function` as such a kernel."""

        def run(*args: Any, **kwargs: Any) -> Any:
            with self.inside_a_kernel():
                return function(*args, **kwargs)

        return run

    def _wait(self, reason: str) -> None:
        if self._counting:
            self.waits[reason] += 1

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = dict(kwargs or {})
        packet, operands = func.overloadpacket, list(leaves([*args, *kwargs.values()]))
        tensors = [value for value in operands if isinstance(value, torch.Tensor)]
        far = [tensor for tensor in tensors if isinstance(tensor, Far)]
        target = kwargs.pop("device", None)
        to_far = bool(far) if target is None else is_far(target)
        if not far and not to_far:
            return func(*args, **kwargs, **({} if target is None else {"device": target}))
        self.operations += 1
        self._look(func, tensors, far, [v for v in operands if isinstance(v, torch.Generator)])
        if packet is aten._fused_sdp_choice:
            return 0  # the one that is written in other operations
        reason = self._why_it_waits(packet, args, kwargs, to_far)
        if reason:
            self._wait(reason)
        kwargs.pop("pin_memory", None)
        placed = {"device": "cpu"} if target is not None else {}
        out = func(*each(near, args), **{name: each(near, value) for name, value in kwargs.items()}, **placed)
        if not to_far:
            return out
        out = each(away, out)
        if not far or packet in COPIES and packet is not aten.copy_ or not isinstance(out, torch.Tensor):
            return self._same(func, args, out)
        return return_and_correct_aliasing(func, args, kwargs, out)

    @staticmethod
    def _same(func: Any, args: Any, out: Any) -> Any:
        """Of several results: what an operation writes into is what it returns."""
        if isinstance(out, (tuple, list)) and any(r.alias_info is not None for r in func._schema.returns):
            if any(r.alias_info.is_write for r in func._schema.returns if r.alias_info is not None):
                raise NotImplementedError(f"{func} writes into several results")
            return return_and_correct_aliasing(func, args, {}, out)
        return out

    @staticmethod
    def _why_it_waits(packet: Any, args: Any, kwargs: Any, to_far: bool) -> str:
        """In a word, empty where it does not."""
        if packet is aten.copy_:
            return "fetched" if isinstance(args[1], Far) and not isinstance(args[0], Far) else ""
        if packet is aten._to_copy:
            return "" if to_far else "fetched"
        if packet in NUMBERS:
            return "number"
        by_truth = packet in INDEXED and any(index is not None and index.dtype == torch.bool for index in args[1])
        counted = packet is aten.repeat_interleave and kwargs.get("output_size") is None
        return "size" if packet in SIZES or by_truth or counted else ""

    def _look(self, func: Any, tensors: list, far: list, generators: list) -> None:
        for generator in generators:
            raise DeviceError(f"{func}: a generator on {generator.device} for a result on a GPU")
        if func.overloadpacket in COPIES:
            return
        if func.overloadpacket in INDEXED and isinstance(tensors[0], Far):
            indices = [t for t in tensors[1:] if t.dtype in (torch.long, torch.int, torch.bool)]
            for _ in (t for t in indices if not isinstance(t, Far)):
                self._wait("index sent")  # CUDA takes them, and copies them at once
            tensors = [t for t in tensors if is_far(t.device) or all(t is not index for index in indices)]
        elementwise = torch.Tag.pointwise in func.tags
        for tensor in tensors:
            if not isinstance(tensor, Far) and is_far(tensor.device):
                raise NotImplementedError(f"{func}: a tensor of {FAR} came into being unseen, and holds nothing")
            if isinstance(tensor, Far) or not far or (elementwise and tensor.ndim == 0):
                continue
            raise DeviceError(f"{func}: expected all tensors on one device, found {tuple(tensor.shape)} on the CPU")


def install(monkeypatch: pytest.MonkeyPatch) -> FarDevice:
    """The far device as torch and Lightning see one: its module with memory and name, fused Adam, and the only device
    that a trainer finds. Enter what is returned."""
    from lightning.pytorch.accelerators import CPUAccelerator
    from lightning.pytorch.strategies import SingleDeviceStrategy

    import tests.render.gsplat_on_cpu as kernels

    device = FarDevice()
    module = SimpleNamespace(
        get_device_name=lambda *_: "a device that is not there",
        max_memory_allocated=lambda *_: 0,
        synchronize=lambda *_: device._wait("clock"),
    )
    monkeypatch.setattr(torch, "get_device_module", lambda *_: module)
    autocast = torch.autocast
    monkeypatch.setattr(
        torch, "autocast", lambda kind, *a, **k: nullcontext() if kind == FAR.type else autocast(kind, *a, **k)
    )
    monkeypatch.setattr(
        import_module("torch.optim.optimizer"), "_get_fused_kernels_supported_devices", lambda: [FAR.type, "cpu"]
    )
    monkeypatch.setattr(SingleDeviceStrategy, "root_device", property(lambda self: FAR, lambda self, value: None))
    monkeypatch.setattr(CPUAccelerator, "setup_device", lambda *_: None)
    for name in ("project", "intersect_tiles", "offsets", "composite"):
        monkeypatch.setattr(kernels, name, device.kernel(getattr(kernels, name)))
    kernels.install(monkeypatch)
    return device
