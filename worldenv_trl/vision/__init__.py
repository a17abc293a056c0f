"""Image features that were learned elsewhere."""

from worldenv_trl.vision.pretrained_encoder import PretrainedEncoder

__all__ = ["PretrainedEncoder"]
