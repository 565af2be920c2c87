"""A camera from its own frames of the pattern: focal length, centre and lens.

The dots are a calibration target of thousands of known places that every session holds
anyway. What a solver needs most, the centre and the bend of the lens, any frames tell; the
focal length only those that are tilted.
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from locatk.core.dots import camera_fit
from locatk.core.dots.camera import Camera
from locatk.core.dots.camera_fit import Fit, Views
from locatk.core.dots.codec import Codec, codec
from locatk.core.dots.frames import Frames
from locatk.core.dots.locate import Sighting, sightings
from locatk.core.dots.sheet import OFFSET, Manifest
from locatk.core.dots.solver import OFF_SHEET, OTHER_SIZE, RIM, UNREADABLE
from locatk.core.errors import DegenerateError, InputError

Array = NDArray[np.float64]

NO_PATTERN = "no_pattern"

FEWEST_FRAMES = 5
"""With fewer, one bad frame cannot be told from a good one."""

MOST_FRAMES = 200
"""Frames that are fitted; more of them tell nothing new."""

MOST_LOCATED = 2 * MOST_FRAMES
"""Frames from which those are chosen."""

MOST_DOTS = 250
"""Of a frame; as many as the paper's camera sees."""

USUAL_FOCAL = 1.56
"""Focal length in diagonals of the frame: 348.7 px for 188 x 120 px, as the paper's camera
has it. Taken where nothing is known."""

LARGEST_FOCAL_SIGMA = 0.05
"""Relative standard deviation with which a focal length counts as known."""

LARGEST_CENTRE_SIGMA = 0.01
"""Standard deviation, in diagonals of the frame, with which a centre counts as known: the
middle of the frame is no worse a guess beyond."""

LARGEST_MISFIT = 1.5
"""Scatter about poses over that about homographies, from which frames are not what a
pinhole sees of a flat sheet at one moment."""

LARGEST_BEND = 0.9
"""Of k times the square of the farthest corner's distance; at 1 the frame folds."""

NOTED_ASPECT = 5e-4
"""Half a tenth of a millimetre on a ruler of 100 mm."""


@dataclass(frozen=True)
class CalibrateOptions:
    """What is known of the camera.

    Attributes
    ----------
    focal_px : float, optional
        Kept, whatever the frames say.
    camera : Camera, optional
        An earlier calibration: with its lens the frames are read at first, and its focal
        length is kept where the frames do not tell one.
    """

    focal_px: float | None = None
    camera: Camera | None = None


@dataclass(frozen=True)
class CameraReport:
    """A camera and how well it is known.

    Attributes
    ----------
    camera : Camera
    focal_from : str
        ``"frames"``; ``"given"``, ``"camera"`` (an earlier one) or ``"usual"`` where it was
        not fitted. k in px^-2 and the centre are right all the same.
    centre_from : str
        ``"frames"``, or ``"middle"`` of the frame.
    sigma_focal_px : float
        Standard deviations; nan of what was not fitted.
    sigma_centre_px : (x, y)
    sigma_radial_px : float
        Of k in px^-2.
    aspect, sigma_aspect : float
        The sheet's scale along x over that along y, minus 1, beyond what the manifest
        says; nan where frames do not tell.
    largest_tilt_rad : float
        nan where the focal length is not known.
    rms_before_px, rms_px : float
        Root mean square distance of dots from where they should be, each frame seen as any
        homography, without a lens; and with the camera.
    rms_flat... 
    """


