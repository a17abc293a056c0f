"""Image features that were learned elsewhere."""

from worldenv_trl.vision.pretrained_encoder import PretrainedEncoder, load_vision

__all__ = ["PretrainedEncoder", "load_vision"]
