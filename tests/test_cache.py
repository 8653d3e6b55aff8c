"""What the byte-bounded cache promises: the bound, the order of eviction, and nothing made twice while it is held."""

import torch
from dreamcatalyst.cache import ByteCache, tensor_bytes


def kilobyte() -> torch.Tensor:
    return torch.zeros(256)


def test_bytes_of_nested_tensors():
    assert tensor_bytes((kilobyte(), [kilobyte(), {"a": kilobyte(), "b": None}])) == 3 * 1024


def test_the_least_recently_used_goes_first():
    made: list[str] = []
    cache = ByteCache(2 * 1024)

    def get(key: str) -> None:
        cache.get(key, lambda: (made.append(key), kilobyte())[1])

    for key in ("a", "b", "a", "c", "a", "b"):  # c pushes out b, since a was used after it
        get(key)
        assert cache.bytes <= cache.limit
    assert made == ["a", "b", "c", "b"]


def test_what_is_too_large_is_handed_out_and_not_kept():
    cache = ByteCache(1000)
    assert cache.get("a", kilobyte).shape == (256,)
    assert (len(cache), cache.bytes) == (0, 0)
    cache.limit = 1024
    cache.get("a", kilobyte)
    assert (len(cache), cache.bytes) == (1, 1024)
    cache.clear()
    assert (len(cache), cache.bytes) == (0, 0)


def test_what_is_put_takes_the_place_of_what_was_there():
    cache = ByteCache(2500)
    cache.put("a", kilobyte())
    cache.put("b", kilobyte())
    again = torch.zeros(300)
    cache.put("a", again)  # and is the latest
    assert cache.find("a") is again and cache.bytes == 1024 + 1200
    cache.put("b", torch.zeros(1000))  # too large: gone, and nothing goes for it
    assert cache.find("b") is None and cache.find("a") is again and cache.bytes == 1200
