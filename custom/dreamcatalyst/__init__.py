"""DreamCatalyst for Gaussian splats: what this extension offers, by the names that a YAML uses.

Importing this package registers those names and imports nothing heavy of its own.
"""

from __future__ import annotations

from . import plugin

OFFERS = {
    "dreamcatalyst-data": ".train.datamodule",
    "dreamcatalyst-fit-system": ".train.fit",
    "dreamcatalyst-edit-system": ".train.edit",
    "dreamcatalyst-delete-system": ".train.delete",
    "dreamcatalyst-add-system": ".train.add",
    "dreamcatalyst-prior-data": ".train.prior.data",
    "dreamcatalyst-prior-system": ".train.prior.system",
    "dreamcatalyst-guidance": ".host.guidance",
    "dreamcatalyst-edit-guidance": ".host.guidance",
}

plugin.offer(OFFERS, __name__)
