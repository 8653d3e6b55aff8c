"""Where work is kept between runs."""

from pathlib import Path

from dreamcatalyst.kept import home


def test_the_folder_of_ones_own_comes_before_the_desktops_before_the_default(monkeypatch):
    monkeypatch.setenv("DREAMCATALYST_CACHE", "~/own")
    monkeypatch.setenv("XDG_CACHE_HOME", "/shared")
    assert home() == Path.home() / "own"
    monkeypatch.delenv("DREAMCATALYST_CACHE")
    assert home() == Path("/shared/dreamcatalyst")
    monkeypatch.delenv("XDG_CACHE_HOME")
    assert home() == Path.home() / ".cache" / "dreamcatalyst"
