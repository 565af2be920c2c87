"""Simulated flights with known truth, independent of the solver and of its simulator.

The aircraft, the stations and the optics are modelled anew from published documents. Of locatk
only the classes of the results are used, so that an error of a model of the solver is not
repeated here and shows as an error of its poses:

- **Motion.** Waypoints with smooth transitions, drift and wind. The attitude follows from the
  acceleration, as that of a quadrotor, with disturbances; a device carried by hand turns freely.
- **Light.** The forward model of libsurvive (cntools/libsurvive, ``src/survive_reproject_gen2.c``,
  MIT) in the axes of that program. Each unit differs from its factory data in tilt, phase, curve
  and ogee, and by a smooth function of the direction that no parameter describes.
- **Rotors.** Periods with an error in ppm that wander slowly. The time of a crossing is solved for
  each photodiode and each plane, since the device moves during a rotation.
- **Deck.** Four photodiodes beside their nominal positions, sensitive to one side. One of four
  reports an LFSR index; the others follow from times in ticks of 24 MHz, so that all four share its
  rounding error (bitcraze/lighthouse-fpga, readme). Groups are lost, in part or as a whole.
- **Faults.** Occlusion, reflections in walls, wrong sweeps, a station that is moved in flight.
- **IMU.** Biases, noise, vibration and the delay of the filters of the device.

The magnitudes in the constants were chosen before the solver was run on these flights. Those
marked (recordings) are pooled figures of public flights of a Crazyflie with motion capture
(bitcraze/positioning_dataset) and of libsurvive's recordings.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import BSpline, make_interp_spline
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from locatk.core.inertial import InertialSamples
from locatk.core.lighthouse.calibration import Calibration
from locatk.core.lighthouse.receiver import DECK, Receiver
from locatk.core.lighthouse.recording import Sweeps
from locatk.core.lighthouse.scene import Marker, MarkerVisit, Scene, Station

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

START_NS = 1_700_000_000_000_000_000
"""Time stamp of the start of each flight [ns since the Unix epoch]."""

DEVICE = "flight"
"""Name of the device."""

GRAVITY_MPS2 = 9.81

# ---- motion

MOTIONS = ("hover", "slow", "agile", "hand")
"""Kinds of motion; ``"hand"`` is carried and turned by hand, the others are flown."""

MEAN_SPEED_MPS = {"hover": 0.3, "slow": 0.3, "agile": 0.9, "hand": 0.4}
"""Mean speed between waypoints [m/s]; the top speed of a leg is 1.9 times as high."""

PAUSE_S = {"hover": (3.0, 8.0), "slow": (0.2, 2.0), "agile": (0.0, 0.3), "hand": (0.0, 1.0)}
"""Range of the pauses at waypoints [s]."""

VOLUME_M = np.array([[-0.8, 0.8], [-0.8, 0.8], [0.4, 1.3]])
"""(3, 2) range of the waypoints along each axis [m]."""

DRIFT_M = {"hover": 0.01, "slow": 0.02, "agile": 0.03, "hand": 0.03}
"""Standard deviation of the deviation from the planned path [m]."""

TURN_RAD = {"hover": 0.03, "slow": 0.4, "agile": 1.2, "hand": 1.5}
"""Standard deviation of the heading [rad]."""

SHAKE_RAD = {"hover": 0.008, "slow": 0.012, "agile": 0.03, "hand": 0.35}
"""Standard deviation of the attitude from that of an ideal quadrotor [rad]."""

SHAKE_CUTOFF_HZ = {"hover": 3.0, "slow": 3.0, "agile": 4.0, "hand": 0.4}
"""Bandwidth of this deviation [Hz]."""

REST_S = 2.0
"""Time at rest on the floor before the take-off and after the landing [s]."""

CLIMB_S = 1.5
"""Duration of take-off and of landing [s]."""

MARKERS_M = np.array([[0.6, -0.6, 0.03], [0.6, 0.6, 0.03], [-0.6, 0.6, 0.03], [-0.6, -0.6, 0.03]])
"""(4, 3) positions of the deck on the markers [m]."""

MARKER_SIGMA_M = 0.002
"""Standard deviation along each axis of the error of a measured marker [m]."""

VISIT_S, CARRY_S, CARRY_HEIGHT_M = 2.0, 1.5, 0.15
"""Rest on a marker, and duration and height of the way by hand to the next one."""

GRID_HZ = 100.0
"""Rate of the nodes of the splines of position and attitude [Hz]."""

# ---- stations

PERIOD_TICKS = {1: 959_000, 2: 957_000, 3: 953_000, 4: 949_000}
"""Ticks of 48 MHz in a rotation by channel (bitcraze/lighthouse-fpga, tools)."""

LENS_SERIES = (-8.0108022e-06, 0.0028679863, 5.3685255e-06, 0.0076069798, 0.0, 0.0)
"""Coefficients of libsurvive's curvature, highest power first (survive_reproject_gen2.c)."""

PHASE, TILT, CURVE, GIBMAG, GIBPHASE, OGEEMAG, OGEEPHASE = range(7)
"""Columns of the parameters of a plane."""

UNIT_MEAN = np.array(
    [
        [0.0, -0.0493, 0.05, -0.005, 2.0, 0.0, 1.9],
        [-0.0051, 0.0459, 0.24, -0.004, 2.1, 0.0, 1.7],
    ]
)
UNIT_SIGMA = np.array(
    [
        [0.0, 0.0016, 0.12, 0.003, 0.5, 0.25, 0.8],
        [0.0019, 0.0020, 0.12, 0.003, 0.5, 0.23, 0.8],
    ]
)
"""(2, 7) mean and standard deviation of the factory data of 11 published units, rounded: a row per
plane, columns as the constants above (angles in radians)."""

DEVIATION_SIGMA = np.array([[1.2e-3, 0.5e-3, 0.1, 0.0, 0.0, 0.12, 0.0]] * 2)
"""(2, 7) standard deviation of a real unit from its factory data (recordings: tilt up to 1 mrad and
phase up to 2.5 mrad beside them; curve and ogee are the least certain terms)."""

FIELD_RAD, FIELD_WAVELENGTH_RAD, FIELD_WAVES = 0.2e-3, (0.7, 1.4), 6
"""Rms and wavelengths over direction of what no parameter describes.

With these deviations, the median residual of the factory data at the true positions is 0.11 mrad
after the best poses of the stations (0.17 mrad rms); on recordings it is 0.14 mrad (0.23 mrad rms).
"""

CLOCK_PPM, WANDER_S = 20.0, 1.0e-6
"""Largest error of the period [ppm], and standard deviation of the wander of the rotor's zero [s]
(recordings: 12 to 32 ticks of 24 MHz within one or two minutes)."""

BEAM_HALF_WIDTH_RAD = (1.30, 0.90)
"""Azimuth and elevation to which a station shines [rad]."""

# ---- deck

TICK_HZ, LFSR_HZ = 24e6, 6e6
"""Rates of the clock of the receiver and of the LFSR [Hz] (bitcraze/lighthouse-fpga)."""

ANGLE_NOISE_RAD, COMMON_NOISE_RAD = 45e-6, 10e-6
"""Noise of a crossing, of each photodiode and common to all of a group [rad] (recordings: 50 to
65 microradians together with the rounding)."""

DECK_SCALE, DIODE_SIGMA_M = 0.015, 2e-4
"""Relative standard deviation of length and width of the deck, and that of the effective position
of each photodiode [m] (recordings)."""

GROUP_LOSS, PARTIAL_LOSS = 0.04, 0.15
"""Fractions of groups that are lost, and of which only some photodiodes are lost (recordings)."""

SHADED_COSINE, LIT_COSINE = 0.05, 0.2
"""Cosine of the angle of incidence below which no light is received, and above which all is."""

PULSE_S = 20e-6
"""Duration of light at the photodiode: of two stations at one time, both are lost [s]."""

# ---- faults and IMU

REFLECTION_S, OCCLUSION_S = (0.05, 1.0), (0.2, 1.5)
"""Ranges of the duration of a reflection and of an occlusion [s]."""

WALL_M = (2.2, 4.0)
"""Range of the distances of reflecting walls from the centre [m]."""

MOVE_M, MOVE_RAD = 0.03, 0.02
"""Standard deviation along each axis of a station's displacement and rotation in flight."""

GEOMETRY_M, GEOMETRY_RAD = 0.01, 0.003
"""Standard deviation along each axis of the error of a given pose of a station, as it is found in
Crazyflies: 5 to 30 mm, and some mrad."""

IMU_HZ, IMU_DELAY_S = 100.0, (0.0, 0.005)
GYRO_BIAS_RADPS, GYRO_NOISE_RADPS = 0.008, 0.004
ACCELERATION_BIAS_MPS2, ACCELERATION_NOISE_MPS2, VIBRATION_MPS2 = 0.08, 0.05, 0.3
IMU_MOUNTING_RAD = 0.015
"""Rate of the samples, and range of the delay of the filters; standard deviations of biases, noise,
vibration in flight, and rotation of the IMU against the deck, along each axis."""


@dataclass(frozen=True)
class FlightOptions:
    """Options of a simulated flight.

    Attributes
    ----------
    motion : str
        One of :data:`MOTIONS`.
    duration_s : float
        From the first sweep to the last, with the rests on the floor.
    stations : int
        1 to 4.
    diodes : int
        4 for the Lighthouse deck, 1 for a single photodiode at the origin of the device.
    geometry : str
        ``"given"``: poses of the stations with an error of :data:`GEOMETRY_M`; ``"exact"``: true
        poses; ``"unknown"``: no stations.
    calibration : bool
        True if the factory data are known.
    deviation : float
        Factor of all deviations of real units from their factory data; 0 for exact factory data.
    deck_error : float
        Factor of the errors of the positions of the photodiodes.
    wrong : float
        Fraction of the sweeps that are replaced by wrong ones.
    reflections, occlusion : float
        Fractions of the time in which a station is received by reflection, and in which it is
        hidden.
    is_station_moved : bool
        True if the last station is displaced during the flight.
    has_markers : bool
        True if the device rests on measured markers before the take-off.
    """

    motion: str = "slow"
    duration_s: float = 40.0
    stations: int = 2
    diodes: int = 4
    geometry: str = "given"
    calibration: bool = True
    deviation: float = 1.0
    deck_error: float = 1.0
    wrong: float = 0.0
    reflections: float = 0.0
    occlusion: float = 0.0
    is_station_moved: bool = False
    has_markers: bool = False


class Motion:
    """True motion of a device; times are seconds since the start of the flight.

    Attributes
    ----------
    flying_s : (float, float)
        Start of the take-off and end of the landing.
    visits_s : (k, 2) ndarray
        Start and end of the rest on each of :data:`MARKERS_M`, before the take-off; k may be 0.
    """

    def __init__(self, rng: np.random.Generator, options: FlightOptions) -> None:
        kind, duration_s = options.motion, options.duration_s
        arrival_s = (VISIT_S + CARRY_S) * np.arange(len(MARKERS_M) * options.has_markers)
        self.visits_s = np.stack([arrival_s, arrival_s + VISIT_S], axis=1)
        self.flying_s = (float(np.max(self.visits_s, initial=REST_S)), duration_s - REST_S)
        self._is_carried = kind == "hand"
        margin_s = 1.0
        time_s = np.arange(-margin_s, duration_s + margin_s, 1 / GRID_HZ)
        climb = (time_s - self.flying_s[0]) / CLIMB_S
        descent = (self.flying_s[1] - time_s) / CLIMB_S
        airborne = _minimum_jerk(climb) * _minimum_jerk(descent)
        path = _waypoint_path(rng, kind, time_s, self.flying_s)
        path = path + DRIFT_M[kind] * np.stack(
            [_smooth_noise(rng, len(time_s), 0.6, 3) for _ in range(3)], axis=1
        )
        floor = np.array([*rng.uniform(-0.3, 0.3, 2), 0.03])
        if options.has_markers:
            floor = MARKERS_M[-1]
        position = airborne[:, None] * (path - floor) + (
            _carried_path(self.visits_s, time_s) if options.has_markers else floor
        )
        self._position = _spline(time_s, gaussian_filter1d(position, 3.0, axis=0))
        self._acceleration = self._position.derivative(2)
        heading = rng.uniform(-np.pi, np.pi) + airborne * TURN_RAD[kind] * _smooth_noise(
            rng, len(time_s), 0.1, 3
        )
        shake = SHAKE_RAD[kind] * np.stack(
            [_smooth_noise(rng, len(time_s), SHAKE_CUTOFF_HZ[kind], 3) for _ in range(3)], axis=1
        )
        shake = np.column_stack([heading, rng.normal(0, 0.01, 3) + airborne[:, None] * shake])
        self._angles = _spline(time_s, gaussian_filter1d(shake, 2.0, axis=0))

    def position(self, time_s: Array) -> Array:
        """Return the positions (..., 3) of the device's origin [m]."""
        return np.asarray(self._position(time_s))

    def rotation(self, time_s: Array) -> Rotation:
        """Return the rotations from the device to the room at times (n,)."""
        heading, shake = np.split(self._angles(time_s), [1], axis=-1)
        thrust = np.zeros((len(time_s), 3))
        if not self._is_carried:
            thrust = np.array(self._acceleration(time_s))
        thrust[:, 2] += GRAVITY_MPS2
        up = thrust / np.linalg.norm(thrust, axis=1, keepdims=True)
        ahead = np.column_stack([np.cos(heading), np.sin(heading), np.zeros(len(up))])
        left = np.cross(up, ahead)
        left /= np.linalg.norm(left, axis=1, keepdims=True)
        axes = np.stack([np.cross(left, up), left, up], axis=2)
        return Rotation.from_matrix(axes) * Rotation.from_rotvec(shake)

    def specific_force(self, time_s: Array) -> Array:
        """Return what an ideal accelerometer measures (n, 3) in the axes of the device [m/s^2]."""
        force = self._acceleration(time_s) + [0.0, 0.0, GRAVITY_MPS2]
        return np.asarray(self.rotation(time_s).inv().apply(force))

    def angular_rate(self, time_s: Array) -> Array:
        """Return the angular rates (n, 3) in the axes of the device [rad/s]."""
        step_s = 1e-3
        before, after = self.rotation(time_s - step_s), self.rotation(time_s + step_s)
        return np.asarray((before.inv() * after).as_rotvec() / (2 * step_s))


@dataclass(frozen=True)
class Unit:
    """Real base station.

    Attributes
    ----------
    channel : int
    position, rotation : (3,) and (3, 3) ndarray
        True pose, axes x forward, y left, z up.
    moved_position, moved_rotation : ndarray
        True pose from ``moved_s`` on.
    moved_s : float
    factory, parameters : (2, 7) ndarray
        Factory data, and the parameters that describe the unit best.
    field : (2, k, 4) ndarray
        Waves of what no parameter describes: amplitude [rad], wave numbers in azimuth and
        elevation, and phase.
    zero_s, period_s : float
        First passage of the rotor's zero, and duration of a rotation.
    wander_s : callable
        From times to the deviation of the rotor's zero [s].
    """

    channel: int
    position: Array
    rotation: Array
    moved_position: Array
    moved_rotation: Array
    moved_s: float
    factory: Array
    parameters: Array
    field: Array
    zero_s: float
    period_s: float
    wander_s: Callable[[Array], Array]

    @property
    def counts(self) -> float:
        """LFSR steps in a rotation."""
        return PERIOD_TICKS[self.channel] / 8

    def to_local(self, points: Array, time_s: Array) -> Array:
        """Return points (..., 3) of the room in the axes of the station at times (...)."""
        is_moved = (time_s >= self.moved_s)[..., None]
        before = (points - self.position) @ self.rotation
        return np.where(is_moved, (points - self.moved_position) @ self.moved_rotation, before)

    def angles(self, local: Array) -> Array:
        """Return the rotor angles of real planes through points; see :func:`libsurvive_angles`.

        ``nan`` if no plane crosses a point.
        """
        angle = libsurvive_angles(local, self.parameters)
        azimuth = np.arctan2(local[..., 1], local[..., 0])
        elevation = np.arctan2(local[..., 2], np.hypot(local[..., 0], local[..., 1]))
        for plane, waves in enumerate(self.field):
            for amplitude, by_azimuth, by_elevation, phase in waves:
                argument = by_azimuth * azimuth[:, plane] + by_elevation * elevation[:, plane]
                angle[:, plane] += amplitude * np.cos(argument + phase)
        return angle


def libsurvive_angles(local: Array, parameters: Array) -> Array:
    """Return the angles at which planes with given parameters cross points.

    Parameters
    ----------
    local : (n, 2, ..., 3) ndarray
        Points in the axes of the station (x forward, y left, z up); axis 1 is the plane.
    parameters : (2, 7) ndarray
        Factory parameters of both planes.

    Returns
    -------
    (n, 2, ...) ndarray
        Radians, 0 straight ahead.
    """
    # libsurvive: X to the right, Y up, Z forward.
    x, y, z = -local[..., 1], local[..., 2], local[..., 0]
    shape = (1, 2, *([1] * (x.ndim - 2)))
    phase, tilt, curve, gib, gib_phase, ogee, ogee_phase = (
        parameters[:, k].reshape(shape) for k in range(7)
    )
    tilt = tilt + (np.pi / 6) * np.array([1.0, -1.0]).reshape(shape)
    with np.errstate(invalid="ignore"):
        b = np.arctan2(z, x)
        sine = np.tan(tilt) * y / np.sqrt(x * x + z * z)
        bend = curve + ogee * np.sin(b - np.arcsin(sine) + ogee_phase)
        along = np.arcsin(y / np.sqrt(x * x + y * y + z * z) / np.cos(tilt))
        value, slope = np.full_like(along, LENS_SERIES[0]), np.zeros_like(along)
        for coefficient in LENS_SERIES[1:]:
            slope = slope * along + value
            value = value * along + coefficient
        sine = sine + value * bend / (np.cos(tilt) - slope * bend * np.sin(tilt))
        crossing = b - np.arcsin(sine)
        angle = crossing + gib * np.sin(crossing + gib_phase) - phase - np.pi / 2
    return np.asarray((angle + np.pi) % (2 * np.pi) - np.pi)


@dataclass(frozen=True)
class Flight:
    """Recording of a flight, what its pilot knows beforehand, and the truth.

    Attributes
    ----------
    sweeps : Sweeps
        One device, :data:`DEVICE`; planes are known, polynomials are not.
    scene : Scene
        Given stations, or factory calibrations only.
    receivers : dict of str to Receiver
        Nominal deck; empty for a single photodiode.
    imu : InertialSamples
        Stamped by the clock of the sweeps; the values are older by the delay of the filters.
    motion : Motion
        Truth.
    units : tuple of Unit
        True stations.
    is_wrong : (n,) bool ndarray
        True for sweeps that are reflections or otherwise wrong.
    options : FlightOptions
    """

    sweeps: Sweeps
    scene: Scene
    receivers: dict[str, Receiver]
    imu: InertialSamples
    motion: Motion
    units: tuple[Unit, ...]
    is_wrong: Mask
    options: FlightOptions

    def true_poses(self, time_ns: NDArray[np.int64]) -> tuple[Array, Rotation]:
        """Return the true positions (n, 3) and rotations of the device at time stamps."""
        time_s = (time_ns - START_NS).astype(float) * 1e-9
        return self.motion.position(time_s), self.motion.rotation(time_s)


def make_flight(seed: int, **options: object) -> Flight:
    """Simulate a flight; ``options`` are those of :class:`FlightOptions`."""
    chosen = FlightOptions(**options)  # type: ignore[arg-type]
    # A generator for each aspect: another motion, for example, leaves the stations as they are.
    streams = [np.random.default_rng([seed, k]) for k in range(6)]
    motion_rng, station_rng, deck_rng, fault_rng, imu_rng, geometry_rng = streams
    motion = Motion(motion_rng, chosen)
    units = tuple(_draw_units(station_rng, chosen))
    diodes_m = np.zeros((1, 3))
    if chosen.diodes > 1:
        scale = 1 + chosen.deck_error * deck_rng.normal(0, DECK_SCALE, 3)
        diodes_m = DECK.position_m * scale
        diodes_m = diodes_m + chosen.deck_error * deck_rng.normal(0, DIODE_SIGMA_M, diodes_m.shape)
    parts = [_receive(unit, motion, diodes_m, chosen, deck_rng, fault_rng) for unit in units]
    rows = np.concatenate(parts)
    rows = _lose_collisions(rows[np.argsort(rows["time_s"], kind="stable")])
    _falsify(rows, chosen.wrong, fault_rng)
    sweeps = Sweeps(
        devices=(DEVICE,),
        time_ns=_stamps_ns(rows["time_s"]),
        device=np.zeros(len(rows), np.int32),
        sensor=rows["sensor"],
        channel=rows["channel"],
        polynomial=np.full(len(rows), -1, np.int32),
        sweep=rows["plane"],
        count=rows["count"],
    )
    return Flight(
        sweeps,
        _known_scene(units, chosen, motion.visits_s, geometry_rng),
        {DEVICE: DECK} if chosen.diodes > 1 else {},
        _measure_inertia(motion, chosen.duration_s, imu_rng),
        motion,
        units,
        rows["is_wrong"],
        chosen,
    )


# ---- motion


def _minimum_jerk(progress: Array) -> Array:
    """Return the smooth transition from 0 to 1 for a progress from 0 to 1."""
    u = np.clip(progress, 0.0, 1.0)
    return u**3 * (10 - 15 * u + 6 * u**2)


def _smooth_noise(rng: np.random.Generator, count: int, cutoff_hz: float, order: int) -> Array:
    """Return noise (count,) of unit variance with a low-pass spectrum."""
    frequency_hz = np.fft.rfftfreq(2 * count, 1 / GRID_HZ)
    gain = 1 / (1 + (frequency_hz / cutoff_hz) ** 2) ** (order / 2)
    gain[0] = 0.0
    spectrum = gain * (rng.normal(size=len(gain)) + 1j * rng.normal(size=len(gain)))
    # The period of the transform is twice that of the flight, so that its ends differ.
    noise = np.fft.irfft(spectrum, 2 * count)
    return np.asarray(noise[:count] / np.sqrt(2 * np.sum(gain**2)) * (2 * count) / np.sqrt(2))


def _waypoint_path(
    rng: np.random.Generator, kind: str, time_s: Array, flying_s: tuple[float, float]
) -> Array:
    """Return positions (n, 3) along random waypoints with pauses between smooth legs."""
    low, high = VOLUME_M.T
    here = rng.uniform(low, high) * [0.5, 0.5, 1.0]
    path = np.tile(here, (len(time_s), 1))
    start_s = flying_s[0] + CLIMB_S
    while start_s < flying_s[1] - CLIMB_S:
        target = rng.uniform(low, high)
        if kind == "hover":
            target = here + rng.normal(0.0, 0.1, 3)
        mean_speed = MEAN_SPEED_MPS[kind] * rng.uniform(0.6, 1.3)
        leg_s = max(float(np.linalg.norm(target - here)) / mean_speed, 0.5)
        progress = _minimum_jerk((time_s - start_s) / leg_s)
        path += progress[:, None] * (target - here)
        here = target
        start_s += leg_s + rng.uniform(*PAUSE_S[kind])
    return path


def _carried_path(visits_s: Array, time_s: Array) -> Array:
    """Return positions (n, 3) from marker to marker, and on the last one from then on."""
    path = np.tile(MARKERS_M[0], (len(time_s), 1))
    for k, leg in enumerate(np.diff(MARKERS_M, axis=0)):
        progress = (time_s - visits_s[k, 1]) / CARRY_S
        path += _minimum_jerk(progress)[:, None] * leg
        height = _minimum_jerk(2 * progress) * _minimum_jerk(2 - 2 * progress)
        path[:, 2] += CARRY_HEIGHT_M * height
    return path


def _spline(time_s: Array, values: Array) -> BSpline:
    return make_interp_spline(time_s, values, k=5)


# ---- stations


def _draw_units(rng: np.random.Generator, options: FlightOptions) -> list[Unit]:
    """Draw stations around the flight volume."""
    count = options.stations
    azimuth = rng.uniform(0, 2 * np.pi) + np.arange(count) * (
        rng.uniform(1.4, 2.6) if count == 2 else 2 * np.pi / count
    )
    units = []
    for k in range(count):
        distance_m = rng.uniform(2.0, 3.2)
        position = np.array(
            [
                distance_m * np.cos(azimuth[k]),
                distance_m * np.sin(azimuth[k]),
                rng.uniform(1.9, 2.5),
            ]
        )
        target = np.array([*rng.normal(0, 0.2, 2), rng.uniform(0.3, 0.8)])
        rotation = _aim(target - position) @ _random_turn(rng, np.radians(4.0))
        moved_s = np.inf
        displacement = rng.normal(0.0, MOVE_M, 3)
        turn = _random_turn(rng, MOVE_RAD)
        moment_s = rng.uniform(0.35, 0.65) * options.duration_s
        if options.is_station_moved and k == count - 1:
            moved_s = moment_s
        factory = rng.normal(UNIT_MEAN, UNIT_SIGMA)
        deviation = np.clip(rng.normal(size=(2, 7)), -2.0, 2.0) * DEVIATION_SIGMA
        wavelength = rng.uniform(*FIELD_WAVELENGTH_RAD, (2, FIELD_WAVES))
        direction = rng.uniform(0, 2 * np.pi, (2, FIELD_WAVES))
        amplitude = np.full(wavelength.shape, FIELD_RAD * np.sqrt(2 / FIELD_WAVES))
        field = np.stack(
            [
                options.deviation * amplitude,
                2 * np.pi / wavelength * np.cos(direction),
                2 * np.pi / wavelength * np.sin(direction),
                rng.uniform(0, 2 * np.pi, wavelength.shape),
            ],
            axis=-1,
        )
        channel = k + 1
        period_s = PERIOD_TICKS[channel] / 48e6 * (1 + rng.uniform(-1, 1) * CLOCK_PPM * 1e-6)
        nodes_s = np.linspace(-5.0, options.duration_s + 5.0, 24)
        wander = make_interp_spline(nodes_s, rng.normal(0, WANDER_S, 24))
        units.append(
            Unit(
                channel,
                position,
                rotation,
                position + displacement,
                rotation @ turn,
                moved_s,
                factory,
                factory + options.deviation * deviation,
                field,
                -period_s * rng.random(),
                period_s,
                wander,
            )
        )
    return units


def _aim(forward: Array) -> Array:
    """Return the axes (3, 3) of a station that looks along ``forward`` without roll."""
    x = forward / np.linalg.norm(forward)
    y = np.array([-x[1], x[0], 0.0]) / np.hypot(x[0], x[1])
    return np.column_stack([x, y, np.cross(x, y)])


def _random_turn(rng: np.random.Generator, sigma_rad: float) -> Array:
    return np.asarray(Rotation.from_rotvec(rng.normal(0.0, sigma_rad, 3)).as_matrix())


EXACT_COVARIANCE = 1e-12 * np.eye(6)
"""Covariance of stations whose true poses are given."""


def _known_scene(
    units: tuple[Unit, ...], options: FlightOptions, visits_s: Array, rng: np.random.Generator
) -> Scene:
    """Return what is known of the stations before the flight."""
    calibrations = {}
    if options.calibration:
        # Factory data are sent as half-precision floats.
        calibrations = {
            u.channel: Calibration(u.factory.astype(np.float16).astype(float), "factory")
            for u in units
        }
    is_known = options.geometry != "unknown"
    if is_known and not calibrations:
        raise ValueError("stations with a given pose need a calibration")
    scale = 1.0 if options.geometry == "given" else 0.0
    stations = tuple(
        Station(
            u.channel,
            u.position + scale * rng.normal(0.0, GEOMETRY_M, 3),
            u.rotation @ _random_turn(rng, scale * GEOMETRY_RAD),
            calibrations[u.channel],
            covariance=None if scale else EXACT_COVARIANCE,
        )
        for u in units
        if is_known
    )
    visits_ns = START_NS + np.round(1e9 * visits_s).astype(np.int64)
    markers = tuple(
        Marker(
            f"marker-{k + 1}",
            MARKERS_M[k] + rng.normal(0.0, MARKER_SIGMA_M, 3),
            (MarkerVisit(DEVICE, int(start_ns), int(end_ns)),),
        )
        for k, (start_ns, end_ns) in enumerate(visits_ns)
    )
    return Scene(
        stations,
        markers,
        planar=False,
        scale="markers" if stations or markers else "unit",
        calibrations=calibrations,
    )


# ---- light

ROW = np.dtype(
    [
        ("time_s", float),
        ("count", float),
        ("sensor", np.int32),
        ("channel", np.int32),
        ("plane", np.int32),
        ("group", np.int64),
        ("is_wrong", bool),
    ]
)
"""A received sweep; the photodiodes that one plane crosses in one rotation have the same group."""


def _receive(
    unit: Unit,
    motion: Motion,
    diodes_m: Array,
    options: FlightOptions,
    deck_rng: np.random.Generator,
    fault_rng: np.random.Generator,
) -> NDArray[np.void]:
    """Return the sweeps of one station that the device receives, in any order."""
    turns = int(options.duration_s / unit.period_s)
    start_s: Array = unit.zero_s + unit.period_s * np.arange(1.0, turns + 1.0)
    start_s = start_s + unit.wander_s(start_s)
    shape = (turns, 2, len(diodes_m))

    hidden_s = _intervals(fault_rng, options.occlusion, OCCLUSION_S, options.duration_s)
    mirrored_s = _intervals(fault_rng, options.reflections, REFLECTION_S, options.duration_s)
    walls = _draw_walls(fault_rng, len(mirrored_s), unit.position)
    run = _interval_of(start_s, mirrored_s)
    is_mirrored = np.zeros((turns, 2), bool)
    # In a third of the reflections, only one of the planes has no direct light.
    sides = np.array([[1, 1], [1, 1], [1, 1], [1, 1], [1, 0], [0, 1]], bool)
    if len(mirrored_s):
        is_mirrored = (run >= 0)[:, None] & fault_rng.choice(sides, len(mirrored_s))[run]
    wall = np.where(is_mirrored[..., None], walls[run][:, None], np.nan)

    fraction = np.broadcast_to(np.array([1 / 3, 2 / 3])[:, None], shape)
    time_s = start_s[:, None, None] + fraction * unit.period_s
    for _ in range(6):
        position, rotation = _diodes(motion, diodes_m, time_s)
        seen = _mirror(position, wall)
        local = unit.to_local(seen, time_s)
        angle = unit.angles(local)
        turned = (angle / (2 * np.pi) + fraction) * unit.period_s
        step_s = start_s[:, None, None] + np.where(np.isfinite(turned), turned, 0.0) - time_s
        time_s = time_s + step_s
    is_lit = np.isfinite(turned) & (np.abs(step_s) < 1e-10)
    azimuth = np.arctan2(local[..., 1], local[..., 0])
    elevation = np.arctan2(local[..., 2], np.hypot(local[..., 0], local[..., 1]))
    is_lit &= (np.abs(azimuth) < BEAM_HALF_WIDTH_RAD[0]) & (
        np.abs(elevation) < BEAM_HALF_WIDTH_RAD[1]
    )
    # The light comes from the station, or from its image behind the wall.
    is_moved = (time_s >= unit.moved_s)[..., None]
    source = _mirror(np.where(is_moved, unit.moved_position, unit.position), wall)
    ray = source - position
    cosine = np.sum(ray * rotation, axis=-1) / np.linalg.norm(ray, axis=-1)
    probability = (cosine - SHADED_COSINE) / (LIT_COSINE - SHADED_COSINE)
    is_lit &= deck_rng.random(shape) < probability
    is_lit &= (_interval_of(start_s, hidden_s) < 0)[:, None, None]
    is_lit &= ~_lost(deck_rng, shape)
    is_lit &= (time_s > 0) & (time_s < options.duration_s)

    noise = deck_rng.normal(0, ANGLE_NOISE_RAD, shape)
    noise += deck_rng.normal(0, COMMON_NOISE_RAD, (turns, 2, 1))
    elapsed = (turned + noise / (2 * np.pi) * unit.period_s) / unit.period_s * unit.counts
    count = _quantize(deck_rng, elapsed, is_lit)
    rows = np.zeros(shape, ROW)
    rows["time_s"], rows["count"] = time_s, count
    rows["sensor"] = np.arange(len(diodes_m))
    rows["channel"] = unit.channel
    rows["plane"] = np.array([0, 1])[:, None]
    rows["group"] = (np.arange(2 * turns).reshape(turns, 2, 1) << 3) + unit.channel
    rows["is_wrong"] = is_mirrored[..., None]
    return rows[is_lit]


def _diodes(motion: Motion, diodes_m: Array, time_s: Array) -> tuple[Array, Array]:
    """Return positions of photodiodes and their optical axes, each (turns, 2, sensors, 3)."""
    flat_s = time_s.ravel()
    rotation = motion.rotation(flat_s)
    offset = np.tile(diodes_m, (flat_s.size // len(diodes_m), 1))
    position = motion.position(flat_s) + rotation.apply(offset)
    axis = rotation.apply([0.0, 0.0, 1.0])
    return position.reshape(*time_s.shape, 3), axis.reshape(*time_s.shape, 3)


def _quantize(rng: np.random.Generator, elapsed: Array, is_lit: Mask) -> Array:
    """Return LFSR indices: one photodiode of a group has a whole one, the others times to it.

    ``elapsed`` (turns, 2, sensors) are exact indices. All photodiodes of a group get the rounding
    error of the one that was decoded, and that of their own time stamp.
    """
    order = np.where(is_lit, rng.random(elapsed.shape), np.inf)
    decoded = np.take_along_axis(elapsed, np.argmin(order, axis=-1)[..., None], axis=-1)
    ticks = TICK_HZ / LFSR_HZ
    return np.asarray(np.rint(decoded) + np.rint((elapsed - decoded) * ticks) / ticks)


def _lost(rng: np.random.Generator, shape: tuple[int, int, int]) -> Mask:
    """Return which sweeps (turns, 2, sensors) are lost on the way."""
    turns, planes, sensors = shape
    kind = rng.random((turns, planes))
    kept = rng.integers(1, max(sensors, 2), (turns, planes))
    rank = np.argsort(rng.random(shape), axis=-1)
    is_partial = (kind < GROUP_LOSS + PARTIAL_LOSS) & (sensors > 1)
    lost = is_partial[..., None] & (rank >= kept[..., None])
    lost |= (kind < GROUP_LOSS)[..., None]
    return np.asarray(lost)


def _lose_collisions(rows: NDArray[np.void]) -> NDArray[np.void]:
    """Return the rows (in order of time) without light of two stations at one time."""
    keep = np.ones(len(rows), bool)
    for sensor in np.unique(rows["sensor"]):
        own = np.flatnonzero(rows["sensor"] == sensor)
        is_close = np.diff(rows["time_s"][own]) < PULSE_S
        is_close &= np.diff(rows["channel"][own]) != 0
        keep[own[:-1][is_close]] = keep[own[1:][is_close]] = False
    return rows[keep]


def _stamps_ns(time_s: Array) -> NDArray[np.int64]:
    """Return time stamps of a clock with 24 MHz."""
    return np.rint(np.rint(time_s * TICK_HZ) / TICK_HZ * 1e9).astype(np.int64) + START_NS


# ---- faults


def _intervals(
    rng: np.random.Generator, fraction: float, range_s: tuple[float, float], duration_s: float
) -> Array:
    """Return ascending, disjoint intervals (k, 2) that cover about a fraction of a duration."""
    if fraction <= 0:
        return np.zeros((0, 2))
    intervals: list[tuple[float, float]] = []
    end_s = 0.0
    mean_s = float(np.mean(range_s))
    while True:
        start_s = end_s + rng.exponential(mean_s * (1 - fraction) / fraction)
        end_s = start_s + rng.uniform(*range_s)
        if start_s > duration_s:
            return np.array(intervals).reshape(-1, 2)
        intervals.append((start_s, end_s))


def _interval_of(time_s: Array, intervals_s: Array) -> NDArray[np.intp]:
    """Return the index of the interval that contains each time; -1 for none."""
    if len(intervals_s) == 0:
        return np.full(time_s.shape, -1, np.intp)
    index = np.searchsorted(intervals_s[:, 0], time_s, side="right") - 1
    return np.where((index >= 0) & (time_s < intervals_s[index, 1]), index, -1)


def _draw_walls(rng: np.random.Generator, count: int, station_m: Array) -> Array:
    """Return vertical walls (count + 1, 4): unit normal, and distance from the centre [m].

    They are opposite to a station or beside it. The last one is not used; an index of -1 stands
    for no wall.
    """
    side = rng.choice([-0.5, 0.0, 0.0, 0.5], count + 1)
    azimuth = np.arctan2(-station_m[1], -station_m[0]) + np.pi * side
    azimuth += rng.normal(0, 0.1, count + 1)
    return np.stack(
        [np.cos(azimuth), np.sin(azimuth), 0 * azimuth, rng.uniform(*WALL_M, count + 1)], axis=1
    )


def _mirror(points: Array, wall: Array) -> Array:
    """Mirror points (turns, 2, sensors, 3) at walls (turns, 2, 4); ``nan`` leaves them."""
    wall = wall[:, :, None, :]
    distance = np.sum(points * wall[..., :3], axis=-1, keepdims=True) - wall[..., 3:]
    mirrored = points - 2 * distance * wall[..., :3]
    return np.where(np.isfinite(mirrored), mirrored, points)


def _falsify(rows: NDArray[np.void], fraction: float, rng: np.random.Generator) -> None:
    """Replace a fraction of the sweeps by wrong ones, in place.

    Half of them are single sweeps with a wrong index anywhere in the field of view, a quarter are
    groups whose common index is wrong by 0.1 to 30 degrees, and a quarter have the label of the
    other plane or of another station.
    """
    total = round(fraction * len(rows))
    if total == 0:
        return
    counts = np.array([PERIOD_TICKS[c] / 8 for c in rows["channel"]])
    order = rng.permutation(len(rows))
    anywhere, labels = order[: total // 2], order[total // 2 : 3 * total // 4]
    middle = (1 + rows["plane"][anywhere]) / 3
    rows["count"][anywhere] = np.floor(
        (middle + rng.uniform(-1 / 6, 1 / 6, len(anywhere))) * counts[anywhere]
    )
    is_plane = rng.random(len(labels)) < 0.5
    rows["plane"][labels[is_plane]] ^= 1
    channels = np.unique(rows["channel"])
    other = labels[~is_plane]
    shift = rng.integers(1, max(len(channels), 2), len(other))
    place = (np.searchsorted(channels, rows["channel"][other]) + shift) % len(channels)
    rows["channel"][other] = channels[place]
    rows["is_wrong"][anywhere] = rows["is_wrong"][labels] = True

    groups, inverse, sizes = np.unique(rows["group"], return_inverse=True, return_counts=True)
    chosen = rng.permutation(len(groups))
    chosen = chosen[: np.searchsorted(np.cumsum(sizes[chosen]), total - total // 2 - len(labels))]
    degrees = np.zeros(len(groups))
    degrees[chosen] = 0.1 * 300 ** rng.random(len(chosen)) * rng.choice([-1, 1], len(chosen))
    step = np.rint(degrees[inverse] / 360 * counts)
    is_inside = (rows["count"] + step >= 0) & (rows["count"] + step < counts)
    rows["count"] += np.where(is_inside, step, -step)
    rows["is_wrong"] |= step != 0


# ---- IMU


def _measure_inertia(
    motion: Motion, duration_s: float, rng: np.random.Generator
) -> InertialSamples:
    """Return the samples of accelerometer and gyroscope."""
    time_s = np.arange(0.0, duration_s, 1 / IMU_HZ)
    measured_s = time_s - rng.uniform(*IMU_DELAY_S)
    mounting = _random_turn(rng, IMU_MOUNTING_RAD)
    is_flying = (time_s > motion.flying_s[0]) & (time_s < motion.flying_s[1])
    shape = (len(time_s), 3)
    noise = np.hypot(ACCELERATION_NOISE_MPS2, VIBRATION_MPS2 * is_flying)[:, None]
    force = motion.specific_force(measured_s) @ mounting
    force += rng.normal(0, ACCELERATION_BIAS_MPS2, 3) + noise * rng.normal(size=shape)
    rate = motion.angular_rate(measured_s) @ mounting
    rate += rng.normal(0, GYRO_BIAS_RADPS, 3) + GYRO_NOISE_RADPS * rng.normal(size=shape)
    return InertialSamples(DEVICE, _stamps_ns(time_s), force, rate)
