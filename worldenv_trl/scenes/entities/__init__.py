"""Objects and fixtures, composed of primitives and textures that MuJoCo generates: no mesh, no image, no download."""

from worldenv_trl.scenes.entities.base import JointState, Primitive, Region
from worldenv_trl.scenes.entities.registry import CATEGORIES, Category, make_entity

__all__ = ["CATEGORIES", "Category", "JointState", "Primitive", "Region", "make_entity"]
