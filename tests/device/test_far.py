"""The far device catches what a GPU would refuse, and lets pass what it would not."""

from __future__ import annotations

from importlib import import_module

import pytest
import torch
from torch.nn import functional as F

from tests.device.far import FAR, Far, FarDevice


@pytest.fixture
def device():
    with FarDevice() as found:
        yield found


def far(*shape: int) -> torch.Tensor:
    return torch.arange(1.0, 1 + torch.Size(shape).numel()).view(shape).to(FAR)


def test_it_computes_and_differentiates(device):
    x = far(3, 4).requires_grad_()
    y = torch.nn.Parameter(torch.ones(4, 2).to(FAR))
    loss = F.softplus(x @ y).square().sum() + x[[0, 2]].mean() + torch.where(x > 3, x, 0.0).sum()
    loss.backward()
    a, b = x.detach().cpu().requires_grad_(), torch.ones(4, 2, requires_grad=True)
    (F.softplus(a @ b).square().sum() + a[[0, 2]].mean() + torch.where(a > 3, a, 0.0).sum()).backward()
    assert isinstance(x.grad, Far) and torch.equal(x.grad.cpu(), a.grad) and torch.equal(y.grad.cpu(), b.grad)


def test_optimizers_and_writing_in_place(device, monkeypatch):
    monkeypatch.setattr(
        import_module("torch.optim.optimizer"), "_get_fused_kernels_supported_devices", lambda: [FAR.type]
    )
    x, a = torch.nn.Parameter(far(5)), torch.nn.Parameter(far(5).cpu())
    for value, fused in ((x, True), (a, False)):
        optimizer = torch.optim.Adam([value], lr=0.1, fused=fused)
        for _ in range(3):
            optimizer.zero_grad()
            value.square().sum().backward()
            optimizer.step()
    torch.testing.assert_close(x.detach().cpu(), a.detach())
    y = torch.zeros(4, device=FAR)
    y[1:3] += 2
    y.clamp_(max=1.5)
    y[y > 1] = 7
    assert y.tolist() == [0, 7, 7, 0] and y.device == FAR


def test_a_number_of_the_cpu_may_take_part(device):
    assert (far(3) * torch.tensor(2.0)).tolist() == [2, 4, 6]


def linear(x):
    return torch.nn.Linear(4, 2)(x)


MISTAKES = {
    "a generator of the CPU": lambda x: torch.randn(3, generator=torch.Generator(), device=x.device),
    "a generator of the CPU, in place": lambda x: x.normal_(generator=torch.Generator()),
    "an index tensor on the CPU": lambda x: x.index_select(0, torch.tensor([1])),
    "gathered by what is on the CPU": lambda x: x.gather(0, torch.zeros(1, 4, dtype=torch.long)),
    "a matrix on the CPU": lambda x: x @ torch.ones(4, 2),
    "zeros without a device": lambda x: x + torch.zeros(3, 4),
    "cat of both": lambda x: torch.cat([x, torch.ones(1, 4)]),
    "stack of both": lambda x: torch.stack([x, torch.ones(3, 4)]),
    "a mask on the CPU": lambda x: torch.where(torch.ones(3, 4) > 0, x, 0.0),
    "lerp by what is on the CPU": lambda x: torch.lerp(x, x + 1, torch.ones(3, 1)),
    "a background on the CPU": lambda x: x[:, :3] + (1 - x[:, 3:]) * torch.ones(3),
    "a module left on the CPU": linear,
    "written into the CPU's": lambda x: torch.zeros(3, 4).add_(x),
    "put by index into the CPU's": lambda x: torch.zeros(3, 4).index_add_(0, torch.tensor([0, 1, 2]), x),
    "another type in a product": lambda x: x @ torch.ones(4, 2, dtype=torch.float64, device=x.device),
    "another type in a convolution": lambda x: F.conv1d(x[None], torch.ones(1, 3, 2, device=x.device).half()),
    "numpy of a far tensor": lambda x: x.numpy(),
    "numpy without asking": lambda x: __import__("numpy").asarray(x),
    "a CPU tensor without dimensions in cat": lambda x: torch.stack([x[0, 0], torch.tensor(1.0)]),
}


@pytest.mark.parametrize("mistake", MISTAKES.values(), ids=MISTAKES.keys())
def test_mistakes_are_caught(device, mistake):
    x = far(3, 4)
    with pytest.raises((RuntimeError, TypeError)) as caught:
        mistake(x)
    assert not isinstance(caught.value, NotImplementedError)  # which is what the device itself cannot do


@pytest.mark.parametrize("look", [lambda row: row.cpu(), lambda row: float(row[0]), lambda row: bool((row > 1).all()),
                                  lambda row: row.tolist(), lambda row: row[row > 2],
                                  lambda row: row.nonzero(), lambda row: row[torch.tensor([0])]])  # fmt: skip
def test_looks_in_a_loop_are_counted(device, look):
    x = far(8, 4)
    for row in x:
        look(row)
    assert sum(device.waits.values()) == 8


def test_what_a_kernel_does_is_not_counted(device):
    device.kernel(lambda x: x.tolist())(far(3))
    assert not device.waits
