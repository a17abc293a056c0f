"""Categories of BDDL files, and the entities that stand for them.

Names are LIBERO's, so that its files load; several categories may share a shape. The stand-ins have the joints, regions
and about the size of what they stand for, not its looks.
"""

from __future__ import annotations

import difflib
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType

from worldenv_trl.scenes.entities.base import Primitive
from worldenv_trl.scenes.entities.cookware import FryingPan, MokaPot, Stove, WideStove
from worldenv_trl.scenes.entities.groceries import Book, Bottle, Can, Carton, Packet
from worldenv_trl.scenes.entities.storage import Basket, Cabinet, Caddy, DeepCabinet, Microwave, Rack, Shelf
from worldenv_trl.scenes.entities.tableware import Bowl, Mug, Plate, Ramekin

__all__ = ["CATEGORIES", "Category", "make_entity"]


@dataclass(frozen=True)
class Category:
    """A word of BDDL files: an entity, the options of its shape, and the yaw between LIBERO's front and ours."""

    entity: type[Primitive]
    options: Mapping[str, object] = field(default_factory=lambda: MappingProxyType({}))
    yaw: float = 0.0

    @property
    def stands(self) -> bool:
        """Whether it is a fixture, which never moves, and no object."""
        return issubclass(self.entity, (Cabinet, Caddy, Microwave, Rack, Shelf, Stove))


def _as(entity: type[Primitive], *, yaw: float = 0.0, **options: object) -> Category:
    return Category(entity, MappingProxyType(options), yaw)


_WHITE, _BLACK = (0.95, 0.95, 0.95, 1), (0.13, 0.13, 0.15, 1)

CATEGORIES: Mapping[str, Category] = MappingProxyType(
    {
        # tableware
        "bowl": _as(Bowl),
        "akita_black_bowl": _as(Bowl, scale=0.80, outside=(0.22, 0.22, 0.25, 1), inside=(0.52, 0.10, 0.08, 1)),
        "green_bowl": _as(Bowl, scale=0.80),
        "white_bowl": _as(Bowl, outside=(0.92, 0.92, 0.93, 1), inside=(0.70, 0.72, 0.76, 1)),
        "red_bowl": _as(Bowl, outside=(0.78, 0.12, 0.10, 1), inside=(0.45, 0.06, 0.05, 1)),
        "plate": _as(Plate, scale=0.72),
        "dinner_plate": _as(Plate),
        "glazed_rim_porcelain_ramekin": _as(Ramekin),
        "porcelain_mug": _as(Mug),
        "red_coffee_mug": _as(Mug, outside=(0.82, 0.12, 0.10, 1), inside=(0.40, 0.22, 0.12, 1)),
        "white_yellow_mug": _as(Mug, band=(0.95, 0.78, 0.10, 1)),
        # groceries
        "alphabet_soup": _as(Can, label=(0.82, 0.10, 0.10, 1), band=_WHITE),
        "tomato_sauce": _as(Can, label=(0.12, 0.45, 0.16, 1), band=(0.85, 0.12, 0.08, 1)),
        "cream_cheese": _as(Packet, size=(0.080, 0.045, 0.034), color=(0.92, 0.94, 0.97, 1), stripe=(0.1, 0.3, 0.8, 1)),
        "butter": _as(Packet, size=(0.090, 0.040, 0.034), color=(0.96, 0.86, 0.30, 1), stripe=(0.85, 0.15, 0.1, 1)),
        "chocolate_pudding": _as(
            Packet, size=(0.075, 0.060, 0.036), color=(0.33, 0.18, 0.10, 1), stripe=(0.93, 0.85, 0.70, 1)
        ),
        "cookies": _as(
            Packet, size=(0.070, 0.100, 0.034), color=(0.80, 0.16, 0.14, 1), stripe=(0.95, 0.80, 0.35, 1), mass=0.3
        ),
        "milk": _as(Carton, color=_WHITE, label=(0.10, 0.35, 0.85, 1)),
        "orange_juice": _as(Carton, color=(0.97, 0.92, 0.80, 1), label=(0.98, 0.55, 0.05, 1)),
        "ketchup": _as(Bottle, glass=(0.80, 0.10, 0.06, 1), label=_WHITE, cap=_WHITE),
        "bbq_sauce": _as(Bottle, glass=(0.30, 0.12, 0.06, 1), label=(0.95, 0.65, 0.10, 1), cap=_BLACK),
        "salad_dressing": _as(Bottle, glass=(0.85, 0.85, 0.62, 1), label=(0.20, 0.60, 0.20, 1), cap=(0.2, 0.5, 0.2, 1)),
        "wine_bottle": _as(
            Bottle, glass=(0.08, 0.25, 0.13, 1), label=(0.90, 0.87, 0.76, 1), cap=(0.5, 0.05, 0.1, 1), tall=True
        ),
        "black_book": _as(Book),
        "yellow_book": _as(Book, cover=(0.93, 0.75, 0.15, 1)),
        # cookware
        "chefmate_8_frypan": _as(FryingPan),
        "moka_pot": _as(MokaPot),
        "flat_stove": _as(WideStove),
        "stove": _as(Stove),
        # storage
        "cabinet": _as(Cabinet),
        "wooden_cabinet": _as(DeepCabinet, yaw=math.pi),
        "white_cabinet": _as(
            DeepCabinet,
            yaw=math.pi,
            wood=(0.85, 0.86, 0.88, 1),
            inside=(0.70, 0.71, 0.74, 1),
            front=(0.95, 0.95, 0.97, 1),
        ),
        "microwave": _as(Microwave),
        "basket": _as(Basket),
        "desk_caddy": _as(Caddy),
        "wine_rack": _as(Rack),
        "wooden_two_layer_shelf": _as(Shelf),
    }
)
WORKSPACES = ("table", "floor", "kitchen_table", "living_room_table", "study_table")
"""Categories that are the arena itself."""


def make_entity(category: str, name: str) -> Primitive:
    """An entity of ``category`` called ``name``; raises ``ValueError`` naming close categories for an unknown one."""
    if category not in CATEGORIES:
        close = difflib.get_close_matches(category, CATEGORIES, n=2, cutoff=0.6)
        hint = f"did you mean {' or '.join(close)}?" if close else f"known ones: {', '.join(CATEGORIES)}"
        raise ValueError(f"unknown category {category!r} of {name!r}: {hint}")
    found = CATEGORIES[category]
    return found.entity(name, **found.options)
