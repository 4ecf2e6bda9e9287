"""Fields: networks over coordinates that stand for the scene and for its motion."""

from napari_fiberburst.fields.joint import JointField

__all__ = ["JointField"]
