"""Frames of bare float32 followed through a stream, whatever happens to its bytes.

A frame is given when the one after it goes on from it. Where one does not, each byte of the
next frames is tried for a start: the values of the right one are close to the last good
ones, those of the others are of other sensors, or no fields at all. Values that no sensor
can have sent become ``nan``, alone, where the frame is not in doubt.

What nothing tells, and what is taken for right: bytes changed so that each float is a whole
number of counts and close to the one before, and whole frames lost.
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
from locatk.formats.devices.decoder import Batch, Counts, Options, Recording, Stream
from locatk.formats.devices.float32.frame_matching import (
    GOOD,
    LOOK,
    Choice,
    Floats,
    Layout,
    Lock,
    Mask,
    Phases,
    choose,
    in_order,
    leaps,
    phases,
    sound,
)
from locatk.formats.devices.float32.synchronization import LEAST, Found, acquire, find_run, majority

STEP, WINDOW, KEPT = 432, 3888, 864
"""Bytes after which the start of a frame is looked for again, at most at a time, and of
them that stay for the next time. A stream is cut at these whatever pieces it came in."""

AT_ONCE, AT_FIRST = 4096, 16
"""Frames checked at once, and after damage."""

PATIENCE = 40
"""Frames after which the values before the damage are no longer expected to go on."""

_TEXT = re.compile(rb"(No sensor \d+ found[ -~]*|Sensor \d+ reset [ -~]*)\r?\n")

_REMARKS = {
    "first": "which sensor is the first is taken from the first byte that came, as the line "
    "never paused between samples: hold a magnet over one end to be sure",
    "guess": "which sensor is the first is a guess: reception began within a sample and the line "
    "never paused. Start the capture before the device, or hold a magnet over one end",
    "alike": "the sensors measure so alike that neither their number nor the first of them is "
    "sure: hold a magnet over one end",
    "moved": "pauses tell that samples start elsewhere than was assumed: before byte {} the "
    "sensors were in a wrong order",
    "turned": "from byte {} on, which sensor is the first is a guess: bytes were lost, and neither "
    "values nor pauses tell how to go on",
    "values": "single values that no sensor can have sent are left out, from byte {} on",
    "text": "the device says: {}",
    "none": "no samples of such an array in the first {} bytes: is it this device, and its baud?",
}


class FloatArrayDecoder:
    """Decoder of arrays whose frames have one of some layouts; see :mod:`.decoder`."""

    def __init__(self, layouts: tuple[Layout, ...]) -> None:
        self.counts = Counts()
        self.remarks: list[str] = []
        self._layouts = layouts
        self._said: set[str] = set()
        self._data = b""
        self._base = 0  # Bytes before _data.
        self._at = 0  # In _data: the held frame, or where to search.
        self._pauses: list[int] = []
        self._silent = False
        self._opened = 0
        self._first: int | None = 0
        self._length = STEP
        self._lock: Lock | None = None
        self._hint: Lock | None = None
        self._held = False
        self._grid = 0
        self._stride = AT_FIRST
        self._gap = 0
        self._seen = False
        self._misses = 0
        self._votes: deque[int] = deque(maxlen=16)
        self._out: list[tuple[Layout, NDArray[np.int64], Floats]] = []

    # ---- the contract

    def feed(self, data: bytes, *, pause: bool = False) -> list[Batch]:
        """See :meth:`.decoder.Decoder.feed`."""
        self._silent |= pause
        if not data:
            return []
        # Before the first byte nobody listened: that is no pause.
        if self._silent and self.counts.bytes > self._opened:
            self._pauses.append(self.counts.bytes)
        self._silent = False
        self.counts.bytes += len(data)
        self._data = self._data[self._at :] + data
        self._base += self._at
        self._at = 0
        return self._work(final=False)

    def restart(self) -> list[Batch]:
        """See :meth:`.decoder.Decoder.restart`."""
        batches = self.finish()
        self._data, self._at, self._base = b"", 0, self.counts.bytes
        self._opened = self._first = self._base
        self._lock, self._hint = None, self._lock or self._hint
        self._held = self._seen = self._silent = False
        self._gap, self._length = 0, STEP
        self._pauses.clear()
        self._votes.clear()
        return batches

    def finish(self) -> list[Batch]:
        """See :meth:`.decoder.Decoder.finish`."""
        return self._work(final=True)

    @np.errstate(all="ignore")  # Any bytes are floats; many are no numbers.
    def _work(self, final: bool) -> list[Batch]:
        going = True
        while going:
            if self._lock is None:
                going = self._hunt(final)
            elif self._held:
                going = self._track(self._lock, final)
            else:
                going = self._search(self._lock, final)
        if final:
            self._close_gap()
        here = self._base + self._at
        self._pauses = [p for p in self._pauses if p >= here]
        batches = []
        for layout in dict.fromkeys(piece[0] for piece in self._out):
            pieces = [piece for piece in self._out if piece[0] == layout]
            end = np.concatenate([piece[1] for piece in pieces])
            batches.append(_batch(layout, end, np.concatenate([piece[2] for piece in pieces])))
        self._out.clear()
        return batches

    # ---- states: each step is the same whatever pieces the bytes came in

    def _hunt(self, final: bool) -> bool:
        """Look for frames where nothing is known."""
        window = self._data[self._at : self._at + WINDOW]
        full = len(window) == WINDOW
        ended = final and not full
        found = None
        least = 2 if ended else LEAST
        if not (full or ended) or find_run(window, self._layouts[0].floats, least):
            while found is None and self._length <= len(window):
                found = self._acquire(window[: self._length], LEAST, self._length == WINDOW)
                self._length += STEP
            if found is None and ended:
                found = self._acquire(window, least, True)
            if found is None and not (full or ended):
                return False
        self._length = STEP
        if found is not None:
            self._lock, self._hint = found.lock, None
            self._grid = self._base + self._at + found.start
            self._misses = 0
            if found.assumed:
                self._say("turned" if self._seen else found.assumed, self._base + self._at)
            return True
        texts = self._tell_text(window)
        passed = len(window) if ended else WINDOW - KEPT
        self._gap += passed
        self._at += passed
        self._first = None
        if not texts and not self.counts.frames and self.counts.bytes:
            self._say("none", self._base + self._at)
        return not ended

    def _acquire(self, window: bytes, least: int, decide: bool) -> Found | None:
        here = self._base + self._at
        first = None if self._first is None else self._first - here
        return acquire(
            window,
            [p - here for p in self._pauses if p >= here],
            self._layouts,
            first=self._tell_text(window) or first,
            hint=self._hint,
            least=least,
            decide=decide,
        )

    def _search(self, lock: Lock, final: bool) -> bool:
        """Look for a frame that goes on from the last good one."""
        size = lock.layout.size
        there = len(self._data) - self._at
        if there < size or (there < (LOOK + 1) * size and not final):
            return False
        among, choice = self._phases(lock, self._at, 1)
        if choice.fits and self._accept(among, choice, lock, self._at, self._at):
            return True
        self._at += size
        self._gap += size
        self._misses += 1
        if self._misses > PATIENCE:
            self._lock, self._hint, self._first = None, lock, None
            self._votes.clear()
        return True

    def _track(self, lock: Lock, final: bool) -> bool:
        """Give the frames of which the next one goes on from them."""
        size = lock.layout.size
        n = min((len(self._data) - self._at) // size, self._stride)
        if n < 2:
            if final:
                self._release(lock, 1)
                self._held = False
            return final
        frames = self._frames(lock, self._at, n)
        wild = lock.wild(frames)
        hurt = wild & ~lock.blind
        before = np.concatenate([lock.last[None], frames[:-1]])
        apart = lock.apart(frames, before)
        cost = lock.cost(apart, hurt).sum(axis=1)
        doubt = cost > GOOD * lock.layout.floats
        if doubt.any():
            far = np.flatnonzero(doubt)
            doubt[far] = ~in_order(lock, frames[far], before[far], cost[far])
        doubt |= hurt.any(axis=1)
        doubt[0] = False
        good = int(np.argmax(doubt)) if doubt.any() else n
        moved = self._vote(lock, good)
        if moved is not None:
            good = (moved - self._base - self._at) // size
        lock = self._release(lock, good - 1, wild[: good - 1] | leaps(lock, apart[:good]))
        if moved is not None:
            self._move(lock, moved)
            return True
        if good < n:
            self._stride = AT_FIRST
            return self._mend(lock, final)
        self._stride = min(2 * self._stride, AT_ONCE)
        return True

    def _mend(self, lock: Lock, final: bool) -> bool:
        """The frame after the held one does not go on from it: find out why."""
        size, held = lock.layout.size, self._at
        if len(self._data) - held < (LOOK + 1) * size and not final:
            return False
        n = min((len(self._data) - held) // size - 1, 2)
        hurt = lock.hurt(self._frames(lock, held + size, n))
        # Where the next frames are fields, none starts within a float, or at another axis.
        among, choice = self._phases(lock, held + 1, 1 if hurt.any() else 4 * lock.step)
        few_hurt = among.few_hurt[:2, among.offset == size - 1]
        if few_hurt.all() and (choice.stays or not choice.leads):
            # Single values were damaged, or all have moved: a shift would have to explain it.
            self._release(lock, 1)
            return True
        frame = self._frames(lock, held, 1)[0]
        tail = lock.cost(lock.apart(frame), lock.hurt(frame))[::-1]
        self._held = False
        if (choice.stays and few_hurt[0]) or sound(tail):
            lock, earliest = self._release(lock, 1), held + size
        else:
            self._gap += size
            self._at += size
            earliest = held + 1
        if choice.fits:
            self._accept(among, choice, lock, held + 1, earliest)
        return True

    def _move(self, lock: Lock, start: int) -> None:
        """Pauses tell that frames start elsewhere, and this one here."""
        self._say("moved", start)
        later = (start - self._base - self._at) % lock.layout.size // 4
        self._lock = self._release(lock, 1).turned(later)
        self._held = False
        self._grid = start
        self._gap += start - self._base - self._at
        self._at = start - self._base
        self._votes.clear()

    # ---- what the states do

    def _phases(self, lock: Lock, origin: int, step: int) -> tuple[Phases, Choice]:
        """Of the frames that start at each ``step``-th byte, up to the last of one frame
        from ``origin`` on, and which of them it is."""
        size = lock.layout.size
        offset = np.arange(size - 1, -1, -step)
        among = phases(lock, self._data[origin : origin + (LOOK + 1) * size], offset)
        here = self._base + origin
        lost = (self._grid - here - offset) % size
        silent = [(p - here) % size for p in self._pauses if 0 <= p - here < LOOK * size]
        pauses = (offset[:, None] == np.array(silent, np.int64)).sum(axis=1)
        return among, choose(among, lock.layout, lost, pauses)

    def _accept(
        self, among: Phases, choice: Choice, lock: Lock, origin: int, earliest: int
    ) -> bool:
        """Hold the first frame on the chosen phase that is whole."""
        best = choice.best
        starts = origin + among.offset[best] + lock.layout.size * np.arange(LOOK)
        self._grid = self._base + int(starts[0])
        usable = (among.cost[:, best] <= choice.most) & among.sound[:, best]
        usable &= among.few_hurt[:, best] & (starts >= earliest)
        if not usable.any():
            return False
        start = int(starts[np.argmax(usable)])
        self._gap += start - self._at
        self._at = start
        self._close_gap()
        self._seen = self._held = True
        self._misses = 0
        if not choice.clear:
            self._say("turned", self._base + start)
        return True

    def _vote(self, lock: Lock, good: int) -> int | None:
        """Where a pause is of which so many others tell that a frame starts there, in the
        good frames after the held one."""
        size = lock.layout.size
        held = self._base + self._at
        step = 4 * lock.step
        for pause in self._pauses:
            if lock.sure or not size <= pause - held < good * size:
                continue
            place = (pause - held) % size
            self._votes.append(-1 if place % step else place)
            if place and majority(self._votes) == place:
                return pause
        return None

    def _release(self, lock: Lock, n: int, without: Mask | None = None) -> Lock:
        """Give the next n frames, but for some values."""
        if not n:
            return lock
        layout = lock.layout
        frames = self._frames(lock, self._at, n)
        without = lock.wild(frames) if without is None else without
        hurt = without[:, : 3 * layout.sensors].any(axis=1)
        values = frames[:, : 3 * layout.sensors]
        if hurt.any():
            values = np.where(without, np.float32(np.nan), frames)[:, : 3 * layout.sensors]
            row = int(np.argmax(hurt))
            self._say("values", self._base + self._at + row * layout.size)
        ends = self._base + self._at + layout.size * np.arange(1, n + 1, dtype=np.int64)
        self._out.append((layout, ends, values))
        self._at += n * layout.size
        self.counts.frames += n
        self._lock = lock.followed(frames[-1], without[-1])
        return self._lock

    def _close_gap(self) -> None:
        if self._seen and self._gap:
            self.counts.skipped += self._gap
            self.counts.bad += 1
        self._gap = 0

    def _frames(self, lock: Lock, at: int, n: int) -> Floats:
        floats = lock.layout.floats
        return np.frombuffer(self._data, "<f4", n * floats, at).reshape(n, floats)

    def _tell_text(self, window: bytes) -> int:
        """Say what the firmware writes where it finds no sensor; where that ends."""
        end = 0
        for text in _TEXT.finditer(window):
            end = text.end()
            self._say("text", text[1].decode().strip())
        return end

    def _say(self, what: str, about: object = "") -> None:
        key = f"{what} {about}" if what == "text" else what
        if key not in self._said and len(self._said) < 20:
            self._said.add(key)
            self.remarks.append(_REMARKS[what].format(about))


def _batch(layout: Layout, end: NDArray[np.int64], values: Floats) -> Batch:
    """Frames in microtesla of the parts as records in tesla of the array: the part's X looks
    to the right, Y back and Z down."""
    by_part = values.reshape(len(values), layout.sensors, 3)
    field_t = np.multiply(by_part[:, :, [1, 0, 2]], -1e-6, dtype=np.float64)
    stream = Stream("magnetometers", sensors=layout.sensors)
    return Batch(stream, end, {"b_tesla": field_t.reshape(len(values), -1)})


POLARIS = (Layout(9), Layout(3))
MAGX = (Layout(8, spare=1),)


class PolarisDecoder(FloatArrayDecoder):
    """Decoder of the device ``polaris-array``."""

    def __init__(self, options: Options) -> None:
        super().__init__(POLARIS)


class MagxDecoder(FloatArrayDecoder):
    """Decoder of the device ``magx-array``."""

    def __init__(self, options: Options) -> None:
        super().__init__(MAGX)


def encode_polaris(recording: Recording) -> Iterator[tuple[int, bytes]]:
    """Yield (time in ns, bytes) of the first array of a recording, a frame a sample.

    Raises
    ------
    InputError
        There is none, or it has neither nine nor three sensors.
    """
    return _encoded(recording, POLARIS, "polaris-array")


def encode_magx(recording: Recording) -> Iterator[tuple[int, bytes]]:
    """Yield (time in ns, bytes) of the first array of a recording, a frame a sample.

    Raises
    ------
    InputError
        There is none, or it has not eight sensors.
    """
    return _encoded(recording, MAGX, "magx-array")


def polaris_artifacts(stream: Stream) -> dict[str, str]:
    """``array.toml`` of the published bar: nine sensors 20 mm apart, or the three of the
    miniature car 8 mm apart, which the published firmware sets to FILTER_5."""
    if stream.sensors == 9:
        array = mlx90393.published_bar(9, 0.020, mlx90393.Settings())
    elif stream.sensors == 3:
        array = mlx90393.published_bar(3, 0.008, mlx90393.Settings(filt=5))
    else:
        return {}
    return {tags.ARRAY_FILE: tags.dumps_array(array)}


def _encoded(
    recording: Recording, layouts: tuple[Layout, ...], name: str
) -> Iterator[tuple[int, bytes]]:
    if not recording.samples:
        raise InputError(f"no samples of magnetometers, which {name} sends")
    samples = recording.samples[0]
    fitting = [layout for layout in layouts if layout.sensors == len(samples.array)]
    if not fitting:
        wanted = " or ".join(str(layout.sensors) for layout in layouts)
        raise InputError(f"{len(samples.array)} sensors, where {name} has {wanted}")
    frames = np.zeros((len(samples), fitting[0].floats), "<f4")
    # The part's X looks to the right, Y back and Z down.
    by_part = -samples.field_t[:, :, [1, 0, 2]] * 1e6
    frames[:, : 3 * fitting[0].sensors] = by_part.reshape(len(samples), -1)
    times = samples.time_ns.tolist()
    return ((time, frame.tobytes()) for time, frame in zip(times, frames, strict=True))
