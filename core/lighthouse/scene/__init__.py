"""Scenes: base stations in a common frame, and their estimation from a recording."""

from locatk.core.lighthouse.scene.model import Distance, Marker, MarkerVisit, Scene, Station

__all__ = ["Distance", "Marker", "MarkerVisit", "Scene", "Station"]
