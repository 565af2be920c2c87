"""Scenes of Lighthouse base stations: data model, estimation from a recording, verification."""

from locatk.core.lighthouse.scene.model import Distance, Marker, MarkerVisit, Scene, Station

__all__ = ["Distance", "Marker", "MarkerVisit", "Scene", "Station"]
