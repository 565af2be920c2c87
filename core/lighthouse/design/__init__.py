"""Design of rooms: visibility, accuracy, placement of stations, and bill of materials."""

from locatk.core.lighthouse.design.materials import bill_of_materials
from locatk.core.lighthouse.design.placement import RoomRequest
from locatk.core.lighthouse.design.report import Addition, RoomReport, best_addition
from locatk.core.lighthouse.design.rooms import RoomDesign, check_room, design_room

__all__ = [
    "Addition",
    "RoomDesign",
    "RoomReport",
    "RoomRequest",
    "best_addition",
    "bill_of_materials",
    "check_room",
    "design_room",
]
