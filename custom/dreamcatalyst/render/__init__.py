"""One `rasterize`, several backends."""
