"""Devices ``polaris-array`` and ``magx-array``: arrays whose firmware sends bare float32.

A frame is x, y, z of sensor 1, 2, ... in microtesla, as little-endian float32: no header, no
length, no checksum. Polaris (github.com/wjk5117/Polaris) has nine sensors, or three on the
miniature car: 108 or 36 bytes. MagX (github.com/dychen24/magx) has eight, and one more float
for the battery that its firmware never sets: 100 bytes.

A frame is returned when the next one continues it. If it does not, each byte of the next frames
is tested as a start: the values of the right start are close to the last valid ones; those of
the others belong to other sensors, or are no fields. Values that no sensor can have sent become
NaN if their frame is certain otherwise.

Undetectable, and accepted: bytes changed such that each float is an integer number of counts and
close to the previous one, and the loss of whole frames.
"""

from __future__ import annotations

import re
from collections import deque
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import InputError
from locatk.core.polaris import mlx90393
from locatk.formats.artifacts import tags
from locatk.formats.devices.float32.frame_matching import (
    GOOD_MEAN_COST,
    LOOKAHEAD_FRAMES,
    Floats,
    FrameLayout,
    FrameModel,
    Mask,
    PhaseChoice,
    PhaseCosts,
    choose_phase,
    evaluate_phases,
    find_isolated_jumps,
    has_sound_prefixes,
    keeps_sensor_order,
)
from locatk.formats.devices.float32.synchronization import (
    MIN_RUN_FRAMES,
    Acquisition,
    acquire,
    find_run,
    majority_position,
)
from locatk.formats.devices.interface import Batch, Counts, Options, Recording, Stream

SEARCH_STEP_BYTES, SEARCH_WINDOW_BYTES, KEPT_BYTES = 432, 3888, 864
"""The search for the start of frames is repeated after so many new bytes, in a window of at most
so many; so many of them remain for the next window. The stream is cut at these bytes however its
pieces arrive."""

MAX_STRIDE_FRAMES, MIN_STRIDE_FRAMES = 4096, 16
"""Frames checked at a time, at most and after damage."""

MAX_MISSED_FRAMES = 40
"""Frames after which the values before the damage are no longer compared."""

MAX_VOTES = 16
"""Latest pauses that decide on the start of a frame."""

MAX_REMARKS = 20

_TEXT = re.compile(rb"(No sensor \d+ found[ -~]*|Sensor \d+ reset [ -~]*)\r?\n")

_REMARKS = {
    "first": "the first sensor is assumed from the first received byte, because the line never "
    "paused between samples: hold a magnet over one end to check",
    "guess": "the first sensor is a guess: reception began within a sample and the line never "
    "paused. Start the capture before the device, or hold a magnet over one end",
    "alike": "the sensors measure such similar values that neither their number nor the first of "
    "them is certain: hold a magnet over one end",
    "moved": "pauses show that samples start at another byte than assumed: before byte {} the "
    "sensors were in a wrong order",
    "shifted": "from byte {} on the first sensor is a guess: bytes were lost, and neither values "
    "nor pauses show the new start",
    "values": "single values that no sensor can have sent are left out, from byte {} on",
    "text": "message of the device: {}",
    "none": "no samples of such an array in the first {} bytes: check --device and --baud",
}


class FloatArrayDecoder:
    """Decoder of arrays whose frames have one of several layouts; see :class:`.decoder.Decoder`.

    It is in one of three states: without a frame model (:meth:`_acquire_step`), with a model but
    without a frame that continues it (:meth:`_search_step`), or with a held frame that waits for
    its successor (:meth:`_track_step`). Steps do not depend on how the bytes are cut.
    """

    def __init__(self, layouts: tuple[FrameLayout, ...]) -> None:
        self.counts = Counts()
        self.remarks: list[str] = []
        self._layouts = layouts
        self._reported: set[str] = set()
        self._data = b""
        self._base = 0  # Bytes before _data.
        self._position = 0  # In _data: the held frame, or the start of the search.
        self._pauses: list[int] = []
        self._was_silent = False
        self._connected_at = 0
        self._first_byte: int | None = 0
        self._window_bytes = SEARCH_STEP_BYTES
        self._model: FrameModel | None = None
        self._hint: FrameModel | None = None
        self._holds_frame = False
        self._frame_start = 0  # Of any earlier frame, which determines the phase.
        self._stride = MIN_STRIDE_FRAMES
        self._gap = 0
        self._has_frames = False
        self._missed = 0
        self._votes: deque[int] = deque(maxlen=MAX_VOTES)
        self._output: list[tuple[FrameLayout, NDArray[np.int64], Floats]] = []

    def feed(self, data: bytes, *, pause: bool = False) -> list[Batch]:
        """Return the samples that these bytes confirm."""
        self._was_silent |= pause
        if not data:
            return []
        # The time before the first byte of a connection is no pause.
        if self._was_silent and self.counts.bytes > self._connected_at:
            self._pauses.append(self.counts.bytes)
        self._was_silent = False
        self.counts.bytes += len(data)
        self._data = self._data[self._position :] + data
        self._base += self._position
        self._position = 0
        return self._run(final=False)

    def restart(self) -> list[Batch]:
        """Return the held samples, and search for the start of a frame again."""
        batches = self.finish()
        self._data, self._position, self._base = b"", 0, self.counts.bytes
        self._connected_at = self._first_byte = self._base
        self._model, self._hint = None, self._model or self._hint
        self._holds_frame = self._has_frames = self._was_silent = False
        self._gap, self._window_bytes = 0, SEARCH_STEP_BYTES
        self._pauses.clear()
        self._votes.clear()
        return batches

    def finish(self) -> list[Batch]:
        """Return the held samples."""
        return self._run(final=True)

    @np.errstate(all="ignore")  # Any bytes are floats; many of them are NaN.
    def _run(self, final: bool) -> list[Batch]:
        """Take steps while the data suffice; return the samples."""
        can_continue = True
        while can_continue:
            if self._model is None:
                can_continue = self._acquire_step(final)
            elif self._holds_frame:
                can_continue = self._track_step(self._model, final)
            else:
                can_continue = self._search_step(self._model, final)
        if final:
            self._count_gap()
        position = self._base + self._position
        self._pauses = [p for p in self._pauses if p >= position]
        batches = []
        for layout in dict.fromkeys(piece[0] for piece in self._output):
            pieces = [piece for piece in self._output if piece[0] == layout]
            end = np.concatenate([piece[1] for piece in pieces])
            batches.append(_batch(layout, end, np.concatenate([piece[2] for piece in pieces])))
        self._output.clear()
        return batches

    # ---- states: each step returns whether another one is possible

    def _acquire_step(self, final: bool) -> bool:
        """Search for frames without a model."""
        window = self._data[self._position : self._position + SEARCH_WINDOW_BYTES]
        is_full = len(window) == SEARCH_WINDOW_BYTES
        is_end = final and not is_full
        acquisition = None
        least = 2 if is_end else MIN_RUN_FRAMES
        if not (is_full or is_end) or find_run(window, self._layouts[0].floats, least):
            while acquisition is None and self._window_bytes <= len(window):
                acquisition = self._acquire(
                    window[: self._window_bytes],
                    MIN_RUN_FRAMES,
                    self._window_bytes == SEARCH_WINDOW_BYTES,
                )
                self._window_bytes += SEARCH_STEP_BYTES
            if acquisition is None and is_end:
                acquisition = self._acquire(window, least, True)
            if acquisition is None and not (is_full or is_end):
                return False
        self._window_bytes = SEARCH_STEP_BYTES
        position = self._base + self._position
        if acquisition is not None:
            self._model, self._hint = acquisition.model, None
            self._frame_start = position + acquisition.start
            self._missed = 0
            if acquisition.assumption:
                self._remark("shifted" if self._has_frames else acquisition.assumption, position)
            return True
        text_end = self._report_text(window)
        passed = len(window) if is_end else SEARCH_WINDOW_BYTES - KEPT_BYTES
        self._gap += passed
        self._position += passed
        self._first_byte = None
        if not text_end and not self.counts.frames and self.counts.bytes:
            self._remark("none", self._base + self._position)
        return not is_end

    def _acquire(self, window: bytes, least: int, decide: bool) -> Acquisition | None:
        position = self._base + self._position
        first = None if self._first_byte is None else self._first_byte - position
        return acquire(
            window,
            [p - position for p in self._pauses if p >= position],
            self._layouts,
            first=self._report_text(window) or first,
            hint=self._hint,
            least=least,
            decide=decide,
        )

    def _search_step(self, model: FrameModel, final: bool) -> bool:
        """Search for a frame that continues the last valid one."""
        size = model.layout.size
        available = len(self._data) - self._position
        if available < size or (available < (LOOKAHEAD_FRAMES + 1) * size and not final):
            return False
        position = self._position
        candidates, choice = self._evaluate_phases(model, position, 1)
        if choice.is_accepted and self._accept(candidates, choice, model, position, position):
            return True
        self._position += size
        self._gap += size
        self._missed += 1
        if self._missed > MAX_MISSED_FRAMES:
            self._model, self._hint, self._first_byte = None, model, None
            self._votes.clear()
        return True

    def _track_step(self, model: FrameModel, final: bool) -> bool:
        """Release the frames that their successors continue."""
        size = model.layout.size
        n = min((len(self._data) - self._position) // size, self._stride)
        if n < 2:
            if final:
                self._release(model, 1)
                self._holds_frame = False
            return final
        frames = self._frames(model, self._position, n)
        impossible = model.is_impossible(frames)
        damaged = impossible & ~model.ignored
        before = np.concatenate([model.last[None], frames[:-1]])
        deviations = model.deviations(frames, before)
        cost = model.cost(deviations, damaged).sum(axis=1)
        is_doubtful = cost > GOOD_MEAN_COST * model.layout.floats
        if is_doubtful.any():
            rows = np.flatnonzero(is_doubtful)
            is_doubtful[rows] = ~keeps_sensor_order(model, frames[rows], before[rows], cost[rows])
        is_doubtful |= damaged.any(axis=1)
        is_doubtful[0] = False
        valid_count = int(np.argmax(is_doubtful)) if is_doubtful.any() else n
        new_start = self._start_by_pauses(model, valid_count)
        if new_start is not None:
            valid_count = (new_start - self._base - self._position) // size
        left_out = impossible[: valid_count - 1] | find_isolated_jumps(
            model, deviations[:valid_count]
        )
        model = self._release(model, valid_count - 1, left_out)
        if new_start is not None:
            self._correct_start(model, new_start)
            return True
        if valid_count < n:
            self._stride = MIN_STRIDE_FRAMES
            return self._resynchronize(model, final)
        self._stride = min(2 * self._stride, MAX_STRIDE_FRAMES)
        return True

    def _resynchronize(self, model: FrameModel, final: bool) -> bool:
        """Decide why the frame after the held one does not continue it."""
        size, held = model.layout.size, self._position
        if len(self._data) - held < (LOOKAHEAD_FRAMES + 1) * size and not final:
            return False
        n = min((len(self._data) - held) // size - 1, 2)
        damaged = model.is_damaged(self._frames(model, held + size, n))
        # If the next frames are fields, no frame starts within a float or at another axis.
        step = 1 if damaged.any() else 4 * model.shift_step
        candidates, choice = self._evaluate_phases(model, held + 1, step)
        is_mostly_intact = candidates.is_mostly_intact[:2, candidates.offset == size - 1]
        if is_mostly_intact.all() and (choice.is_unshifted or not choice.has_clear_lead):
            # Single values were damaged, or all have moved; a shift would need a clear lead.
            self._release(model, 1)
            return True
        frame = self._frames(model, held, 1)[0]
        tail = model.cost(model.deviations(frame), model.is_damaged(frame))[::-1]
        self._holds_frame = False
        if (choice.is_unshifted and is_mostly_intact[0]) or has_sound_prefixes(tail):
            model, earliest = self._release(model, 1), held + size
        else:
            self._gap += size
            self._position += size
            earliest = held + 1
        if choice.is_accepted:
            self._accept(candidates, choice, model, held + 1, earliest)
        return True

    def _correct_start(self, model: FrameModel, start: int) -> None:
        """Continue with frames that start at byte ``start``, as pauses show."""
        self._remark("moved", start)
        skipped = start - self._base - self._position
        shift = skipped % model.layout.size // 4
        self._model = self._release(model, 1).shifted(shift)
        self._holds_frame = False
        self._frame_start = start
        self._gap += start - self._base - self._position
        self._position = start - self._base
        self._votes.clear()

    # ---- parts of the steps

    def _evaluate_phases(
        self, model: FrameModel, origin: int, step: int
    ) -> tuple[PhaseCosts, PhaseChoice]:
        """Evaluate each ``step``-th byte of one frame from ``origin`` on as start of a frame."""
        size = model.layout.size
        offset = np.arange(size - 1, -1, -step)
        piece = self._data[origin : origin + (LOOKAHEAD_FRAMES + 1) * size]
        candidates = evaluate_phases(model, piece, offset)
        position = self._base + origin
        lost = (self._frame_start - position - offset) % size
        paused = [
            (p - position) % size
            for p in self._pauses
            if 0 <= p - position < LOOKAHEAD_FRAMES * size
        ]
        pauses = (offset[:, None] == np.array(paused, np.int64)).sum(axis=1)
        return candidates, choose_phase(candidates, model.layout, lost, pauses)

    def _accept(
        self,
        candidates: PhaseCosts,
        choice: PhaseChoice,
        model: FrameModel,
        origin: int,
        earliest: int,
    ) -> bool:
        """Hold the first intact frame on the chosen phase; return whether there is one."""
        best = choice.best
        frame_offsets = model.layout.size * np.arange(LOOKAHEAD_FRAMES)
        starts = origin + candidates.offset[best] + frame_offsets
        self._frame_start = self._base + int(starts[0])
        usable = (candidates.cost[:, best] <= choice.max_cost) & candidates.is_sound[:, best]
        usable &= candidates.is_mostly_intact[:, best] & (starts >= earliest)
        if not usable.any():
            return False
        start = int(starts[np.argmax(usable)])
        self._gap += start - self._position
        self._position = start
        self._count_gap()
        self._has_frames = self._holds_frame = True
        self._missed = 0
        if not choice.is_unambiguous:
            self._remark("shifted", self._base + start)
        return True

    def _start_by_pauses(self, model: FrameModel, valid_count: int) -> int | None:
        """Return a pause within the next frames if most pauses show another start of a frame."""
        size = model.layout.size
        held = self._base + self._position
        step = 4 * model.shift_step
        for pause in self._pauses:
            if model.is_unambiguous or not size <= pause - held < valid_count * size:
                continue
            phase = (pause - held) % size
            self._votes.append(-1 if phase % step else phase)
            if phase and majority_position(self._votes) == phase:
                return pause
        return None

    def _release(self, model: FrameModel, n: int, left_out: Mask | None = None) -> FrameModel:
        """Return the next n frames, except some values, and the model after them."""
        if not n:
            return model
        layout = model.layout
        frames = self._frames(model, self._position, n)
        left_out = model.is_impossible(frames) if left_out is None else left_out
        is_incomplete = left_out[:, : 3 * layout.sensors].any(axis=1)
        values = frames[:, : 3 * layout.sensors]
        position = self._base + self._position
        if is_incomplete.any():
            values = np.where(left_out, np.float32(np.nan), frames)[:, : 3 * layout.sensors]
            self._remark("values", position + int(np.argmax(is_incomplete)) * layout.size)
        ends = position + layout.size * np.arange(1, n + 1, dtype=np.int64)
        self._output.append((layout, ends, values))
        self._position += n * layout.size
        self.counts.frames += n
        self._model = model.updated(frames[-1], left_out[-1])
        return self._model

    def _count_gap(self) -> None:
        if self._has_frames and self._gap:
            self.counts.skipped += self._gap
            self.counts.bad += 1
        self._gap = 0

    def _frames(self, model: FrameModel, position: int, n: int) -> Floats:
        floats = model.layout.floats
        return np.frombuffer(self._data, "<f4", n * floats, position).reshape(n, floats)

    def _report_text(self, window: bytes) -> int:
        """Report error messages of the firmware as remarks; return the end of the last one."""
        end = 0
        for text in _TEXT.finditer(window):
            end = text.end()
            self._remark("text", text[1].decode().strip())
        return end

    def _remark(self, key: str, argument: object = "") -> None:
        identity = f"{key} {argument}" if key == "text" else key
        if identity not in self._reported and len(self._reported) < MAX_REMARKS:
            self._reported.add(identity)
            self.remarks.append(_REMARKS[key].format(argument))


def _batch(layout: FrameLayout, end: NDArray[np.int64], values: Floats) -> Batch:
    """Return frames in microtesla of the parts as records in tesla along the array's axes.

    X of the part points right, Y back and Z down.
    """
    by_part = values.reshape(len(values), layout.sensors, 3)
    field_t = np.multiply(by_part[:, :, [1, 0, 2]], -1e-6, dtype=np.float64)
    stream = Stream("magnetometers", sensors=layout.sensors)
    return Batch(stream, end, {"b_tesla": field_t.reshape(len(values), -1)})


POLARIS_LAYOUTS = (FrameLayout(9), FrameLayout(3))
MAGX_LAYOUTS = (FrameLayout(8, spare=1),)


class PolarisDecoder(FloatArrayDecoder):
    """Decoder of the device ``polaris-array``."""

    def __init__(self, options: Options) -> None:
        super().__init__(POLARIS_LAYOUTS)


class MagxDecoder(FloatArrayDecoder):
    """Decoder of the device ``magx-array``."""

    def __init__(self, options: Options) -> None:
        super().__init__(MAGX_LAYOUTS)


def encode_polaris(recording: Recording) -> Iterator[tuple[int, bytes]]:
    """Return (time in ns, bytes) of the first array of a recording, one frame per sample.

    Raises
    ------
    InputError
        There is no array, or it has neither nine nor three sensors.
    """
    return _encode(recording, POLARIS_LAYOUTS, "polaris-array")


def encode_magx(recording: Recording) -> Iterator[tuple[int, bytes]]:
    """Return (time in ns, bytes) of the first array of a recording, one frame per sample.

    Raises
    ------
    InputError
        There is no array, or it does not have eight sensors.
    """
    return _encode(recording, MAGX_LAYOUTS, "magx-array")


def polaris_artifacts(stream: Stream) -> dict[str, str]:
    """Return ``array.toml`` of the published bar with the published settings.

    It has nine sensors 20 mm apart, or the three of the miniature car 8 mm apart, which the
    published firmware sets to FILTER_5. MagX was published with seven layouts of eight sensors
    (Codes/optimization/config.py of the release), so that it has no such function.
    """
    if stream.sensors == 9:
        array = mlx90393.published_bar(9, 0.020, mlx90393.Settings())
    elif stream.sensors == 3:
        array = mlx90393.published_bar(3, 0.008, mlx90393.Settings(filt=5))
    else:
        return {}
    return {tags.ARRAY_FILE: tags.dumps_array(array)}


def _encode(
    recording: Recording, layouts: tuple[FrameLayout, ...], name: str
) -> Iterator[tuple[int, bytes]]:
    if not recording.samples:
        raise InputError(f"no samples of magnetometers, which {name} sends")
    samples = recording.samples[0]
    fitting = [layout for layout in layouts if layout.sensors == len(samples.array)]
    if not fitting:
        allowed = " or ".join(str(layout.sensors) for layout in layouts)
        raise InputError(f"{len(samples.array)} sensors, but {name} has {allowed}")
    frames = np.zeros((len(samples), fitting[0].floats), "<f4")
    # X of the part points right, Y back and Z down.
    by_part = -samples.field_t[:, :, [1, 0, 2]] * 1e6
    frames[:, : 3 * fitting[0].sensors] = by_part.reshape(len(samples), -1)
    times = samples.time_ns.tolist()
    return ((time, frame.tobytes()) for time, frame in zip(times, frames, strict=True))
