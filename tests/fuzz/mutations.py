"""Random damage of files, of their bytes or of what they contain.

Each function takes the content of a valid file and a random generator, and returns damaged
content. Those of a format repair its frame (checksums, lengths), so that the damage reaches the
code behind the checks.
"""

from __future__ import annotations

import io
import re
import struct
import zlib
from collections.abc import Callable, Sequence

import numpy as np
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

from locatk.formats.devices.dotbot_gateway import decode_hdlc, encode_hdlc
from locatk.formats.devices.locatk_frames.framing import encode_frame
from locatk.formats.schemas.serial_pb2 import SerialChunk

Rng = np.random.Generator
Damage = Callable[[bytes, Rng], bytes]

NUMBERS = (
    *("0", "-1", "1", "nan", "inf", "-inf", "1e308", "-1e308", "1e-320", "1e9", "0.1", "-0.0"),
    *("9223372036854775807", "-9223372036854775808", "18446744073709551615", "4294967296"),
    *("1" * 5000, "0x10", "1_000", "+5", "1,5"),
)
"""Numbers at the limits of their types."""

TEXTS = (
    *("", " ", "a", "x" * 70_000, "\0", "\x1b[31m", "\u202e", "\U0001f600", "../../etc/passwd"),
    *("/", "a/b", "=1+1", "nan", "true", "'", '"', "\n", "NaT", "2023-02-30T25:00:00Z"),
)
"""Texts that some reader may take for something else."""

INTEGERS = (0, 1, 2, 127, 128, 255, 256, 65535, 2**31 - 1, 2**31, 2**32 - 1, 2**62, 2**63 - 1)
INTEGERS += (2**63, 2**64 - 1)

DOUBLES = (0.0, -0.0, 1.0, -1.0, 1e-300, 1e300, -1e300, 1e18, np.nan, np.inf, -np.inf, 5e-324)


def choose(rng: Rng, values: Sequence[object]) -> object:
    return values[int(rng.integers(len(values)))]


def damage_bytes(data: bytes, rng: Rng) -> bytes:
    """Flip, cut, repeat, overwrite or insert bytes, one to four times."""
    for _ in range(int(rng.integers(1, 5))):
        size = len(data)
        start = int(rng.integers(size + 1))
        stop = min(size, start + int(2 ** rng.uniform(0, 12)))
        match int(rng.integers(7)):
            case 0 if size:
                start = min(start, size - 1)
                bit = 1 << int(rng.integers(8))
                data = data[:start] + bytes([data[start] ^ bit]) + data[start + 1 :]
            case 1:
                data = data[:start] + data[stop:]
            case 2:
                data = data[:start] + data[start:stop] * int(2 ** rng.uniform(1, 6)) + data[stop:]
            case 3:
                width = int(rng.choice([1, 2, 4, 8]))
                number = int(choose(rng, INTEGERS)) % 2 ** (8 * width)  # type: ignore[call-overload]
                word = number.to_bytes(width, "little" if rng.random() < 0.7 else "big")
                data = data[:start] + word + data[start + width :]
            case 4:
                data = data[:start] + rng.bytes(stop - start) + data[stop:]
            case 5:
                data = data[:start]
            case _:
                other = int(rng.integers(size + 1))
                data = data[:start] + data[other : other + stop - start] + data[start:]
    return data


def damage_text(data: bytes, rng: Rng) -> bytes:
    """Replace numbers, and delete, repeat or exchange lines, or damage the bytes."""
    if rng.random() < 0.2:
        return damage_bytes(data, rng)
    text = data.decode("utf-8", "replace")
    for _ in range(int(rng.integers(1, 4))):
        lines = text.splitlines(keepends=True)
        if not lines:
            break
        # Tables are long; their first rows and headers matter most.
        row = int(len(lines) * rng.random() ** 2)
        match int(rng.integers(6)):
            case 0 | 1:
                numbers = list(re.finditer(r"(?<![\w.])-?\d[\d.eE_+-]*", lines[row]))
                if numbers:
                    place = numbers[int(rng.integers(len(numbers)))]
                    new = str(choose(rng, NUMBERS))
                    lines[row] = lines[row][: place.start()] + new + lines[row][place.end() :]
            case 2:
                words = list(re.finditer(r"\w+", lines[row]))
                if words:
                    place = words[int(rng.integers(len(words)))]
                    new = str(choose(rng, TEXTS))
                    lines[row] = lines[row][: place.start()] + new + lines[row][place.end() :]
            case 3:
                del lines[row]
            case 4:
                lines[row:row] = [lines[int(rng.integers(len(lines)))]] * int(rng.integers(1, 4))
            case _:
                cells = lines[row].rstrip("\n").split(",")
                cell = int(rng.integers(len(cells)))
                if rng.random() < 0.5:
                    del cells[cell]
                else:
                    cells.insert(cell, str(choose(rng, NUMBERS + TEXTS)))
                lines[row] = ",".join(cells) + "\n"
        text = "".join(lines)
    return text.encode("utf-8", "replace")


def damage_toml(data: bytes, rng: Rng) -> bytes:
    """Give keys other values or types, or damage as text."""
    if rng.random() < 0.4:
        return damage_text(data, rng)
    lines = data.decode("utf-8", "replace").split("\n")
    rows = [k for k, line in enumerate(lines) if re.match(r"\s*[\w.\"-]+\s*=", line)]
    for _ in range(int(rng.integers(1, 4)) if rows else 0):
        row = rows[int(rng.integers(len(rows)))]
        key, _, value = lines[row].partition("=")
        texts = [f'"{text}"' for text in ("", "a", "x" * 5000, "\\u202e", "../x", "nan")]
        others = ["[]", "{}", "[[]]", "[1, 'a']", "[1.0, nan, inf]", "true", "1979-05-27", *texts]
        match int(rng.integers(4)):
            case 0:
                value = str(choose(rng, NUMBERS[:16]))
            case 1:
                value = str(choose(rng, others))
            case 2:
                value = f"[{value}]"
            case _:
                value = re.sub(
                    r"-?\d+(\.\d+)?", lambda _: str(choose(rng, NUMBERS[:16])), value, count=1
                )
        lines[row] = f"{key}= {value}"
    return "\n".join(lines).encode("utf-8", "replace")


# ---- protobuf


def _varint(value: int) -> bytes:
    coded = bytearray()
    value %= 1 << 64
    while value > 127:
        coded.append(value & 127 | 128)
        value >>= 7
    return bytes([*coded, value])


def _read_varint(data: bytes, at: int) -> tuple[int, int]:
    value = shift = 0
    while True:
        byte = data[at]
        value |= (byte & 127) << shift
        at, shift = at + 1, shift + 7
        if byte < 128:
            return value, at


def _fields(data: bytes) -> list[tuple[int, int, bytes | int]] | None:
    """Split a message into (number, wire type, value), or return None if it is none."""
    found: list[tuple[int, int, bytes | int]] = []
    at = 0
    try:
        while at < len(data):
            key, at = _read_varint(data, at)
            number, wire = key >> 3, key & 7
            value: bytes | int
            if wire == 0:
                value, at = _read_varint(data, at)
            elif wire in (1, 5):
                size = 8 if wire == 1 else 4
                value, at = data[at : at + size], at + size
            elif wire == 2:
                size, at = _read_varint(data, at)
                value, at = data[at : at + size], at + size
            else:
                return None
            if number == 0 or at > len(data):
                return None
            found.append((number, wire, value))
    except IndexError:
        return None
    return found


def _join(fields: Sequence[tuple[int, int, bytes | int]]) -> bytes:
    parts = []
    for number, wire, value in fields:
        parts.append(_varint(number << 3 | wire))
        if isinstance(value, int):
            parts.append(_varint(value))
        else:
            parts.append(_varint(len(value)) + value if wire == 2 else value)
    return b"".join(parts)


def damage_protobuf(data: bytes, rng: Rng) -> bytes:
    """Replace, drop or repeat a field of a message or of one inside it."""
    fields = _fields(data)
    if not fields or rng.random() < 0.1:
        return damage_bytes(data, rng)
    row = int(rng.integers(len(fields)))
    number, wire, value = fields[row]
    action = rng.random()
    if action < 0.08:
        del fields[row]
    elif action < 0.14:
        fields.insert(row, fields[int(rng.integers(len(fields)))])
    elif isinstance(value, int):
        fields[row] = (number, wire, int(choose(rng, INTEGERS)))  # type: ignore[call-overload]
    elif wire == 2:
        fields[row] = (number, wire, _damage_content(value, rng))
    else:
        fields[row] = (number, wire, _special(len(value), rng))
    return _join(fields)


def _special(size: int, rng: Rng) -> bytes:
    """Return a number of 4 or 8 bytes at the limit of its type."""
    if rng.random() < 0.5:
        with np.errstate(over="ignore"):
            return np.float64(choose(rng, DOUBLES)).astype(f"<f{size}").tobytes()
    return (int(choose(rng, INTEGERS)) % 2 ** (8 * size)).to_bytes(size, "little")  # type: ignore[call-overload]


def _damage_content(value: bytes, rng: Rng) -> bytes:
    """Damage a message, packed numbers, a text or bytes."""
    inner = _fields(value)
    if inner and rng.random() < 0.7:
        return damage_protobuf(value, rng)
    if len(value) >= 8 and len(value) % 8 == 0 and rng.random() < 0.7:
        words = [value[k : k + 8] for k in range(0, len(value), 8)]
        row = int(rng.integers(len(words)))
        match int(rng.integers(5)):
            case 0:
                words[row] = _special(8, rng)
            case 1:
                words = [_special(8, rng)] * len(words)
            case 2:
                words.pop(row)
            case 3:
                words[row:row] = words[row : row + 1] * int(rng.integers(1, 100))
            case _:
                (number,) = struct.unpack("<d", words[row])
                words[row] = struct.pack("<d", number * float(rng.normal(1, 3)))
        return b"".join(words)
    if rng.random() < 0.3:
        return str(choose(rng, TEXTS)).encode()
    return damage_bytes(value, rng)


# ---- MCAP


def damage_mcap(data: bytes, rng: Rng) -> bytes:
    """Damage messages, channels, attachments or metadata, and write the file with new checksums."""
    reader = make_reader(io.BytesIO(data))
    summary = reader.get_summary()
    assert summary is not None
    messages = [
        [m.channel_id, m.log_time, m.publish_time, m.data]
        for _, _, m in reader.iter_messages(log_time_order=False)
    ]
    attachments = [[a.name, a.media_type, a.log_time, a.data] for a in reader.iter_attachments()]
    metadata = [[m.name, dict(m.metadata)] for m in reader.iter_metadata()]
    schemas = {key: [s.name, s.encoding, s.data] for key, s in summary.schemas.items()}
    channels = {
        key: [c.topic, c.message_encoding, c.schema_id, dict(c.metadata)]
        for key, c in summary.channels.items()
    }
    for _ in range(int(rng.integers(1, 4))):
        kind = rng.random()
        if kind < 0.6 and messages:
            # Half of the choices fall on a random topic, because most messages are of one.
            topics = sorted({m[0] for m in messages})
            topic = choose(rng, topics)
            rows = [k for k, m in enumerate(messages) if m[0] == topic or rng.random() < 0.5]
            _damage_message(messages, rows[int(rng.integers(len(rows)))], rng)
        elif kind < 0.8 and attachments:
            part = attachments[int(rng.integers(len(attachments)))]
            column = int(rng.choice([0, 1, 2, 3], p=[0.1, 0.05, 0.05, 0.8]))
            if column == 3:
                is_toml = part[0].endswith(".toml") and re.search(rb"=", part[3])
                part[3] = (damage_toml if is_toml else damage_bytes)(part[3], rng)
            else:
                part[column] = choose(rng, INTEGERS if column == 2 else TEXTS)
        elif kind < 0.92 and metadata:
            name, record = metadata[int(rng.integers(len(metadata)))]
            if record:
                key = choose(rng, sorted(record))
                if rng.random() < 0.2:
                    del record[key]
                else:
                    record[key] = str(choose(rng, NUMBERS + TEXTS))
        elif channels:
            entry = channels[int(choose(rng, sorted(channels)))]  # type: ignore[call-overload]
            other = channels[int(choose(rng, sorted(channels)))]  # type: ignore[call-overload]
            column = int(rng.integers(3))
            entry[column] = other[column] if rng.random() < 0.6 else entry[column]
            if rng.random() < 0.3:
                schema = schemas[int(choose(rng, sorted(schemas)))]  # type: ignore[call-overload]
                schema[2] = damage_bytes(schema[2], rng)
    packed = io.BytesIO()
    writer = Writer(
        packed, compression=CompressionType.NONE, chunk_size=1 << int(rng.integers(10, 21))
    )
    header = reader.get_header()
    writer.start(header.profile, header.library)
    schema_ids = {key: writer.register_schema(*schema) for key, schema in schemas.items()}
    ids = {
        key: writer.register_channel(topic, encoding, schema_ids.get(schema, 0), record)
        for key, (topic, encoding, schema, record) in channels.items()
    }
    for part in attachments:
        name, media_type, log_time, content = part
        writer.add_attachment(int(log_time), int(log_time), str(name), str(media_type), content)
    for k, (channel, log_time, publish_time, content) in enumerate(messages):
        writer.add_message(ids[channel], log_time, content, publish_time, k)
    for name, record in metadata:
        writer.add_metadata(name, record)
    writer.finish()
    return packed.getvalue()


def _damage_message(messages: list[list[object]], row: int, rng: Rng) -> None:
    """Damage the content or the times of a message, or drop or repeat it."""
    message = messages[row]
    action = rng.random()
    if action < 0.8:
        message[3] = damage_protobuf(bytes(message[3]), rng)  # type: ignore[call-overload]
    elif action < 0.88:
        message[int(rng.integers(1, 3))] = choose(rng, INTEGERS)
    elif action < 0.94:
        del messages[row]
    else:
        messages.insert(int(rng.integers(len(messages))), list(message))


# ---- serial lines


def damage_stream(data: bytes, rng: Rng) -> bytes:
    """Damage the bytes of a serial line, within frames with right checksums or anywhere.

    They are recorded again in pieces of other sizes.
    """
    messages = [m for _, _, m in make_reader(io.BytesIO(data)).iter_messages()]
    chunks = [SerialChunk.FromString(message.data) for message in messages]
    wire = b"".join(chunk.data for chunk in chunks)
    for _ in range(int(rng.integers(1, 4))):
        wire = _damage_frame(wire, rng) if rng.random() < 0.7 else damage_bytes(wire, rng)
    packed = io.BytesIO()
    writer = Writer(packed, compression=CompressionType.NONE)
    writer.start("", "fuzz")
    schema = writer.register_schema("locatk.SerialChunk", "protobuf", _descriptor(data))
    channel = writer.register_channel("/serial/robot", "protobuf", schema)
    time_ns, at = messages[0].log_time, 0
    while at < len(wire):
        size = int(2 ** rng.uniform(0, 12))
        chunk = SerialChunk(byte_offset=at, data=wire[at : at + size])
        writer.add_message(channel, time_ns, chunk.SerializeToString(), time_ns)
        time_ns, at = time_ns + int(rng.exponential(2e7)), at + size
    writer.finish()
    return packed.getvalue()


def _descriptor(data: bytes) -> bytes:
    """Return the definition of the messages in a recording of a serial line."""
    summary = make_reader(io.BytesIO(data)).get_summary()
    assert summary is not None
    return next(s.data for s in summary.schemas.values() if s.name == "locatk.SerialChunk")


def _damage_frame(wire: bytes, rng: Rng) -> bytes:
    """Damage the content of a frame of one of the protocols, and repair its checksum."""
    delimiter, unpack, pack = (
        (b"\0", _content_of_cobs, encode_frame)
        if rng.random() < 0.5
        else (b"\x7e", decode_hdlc, encode_hdlc)
    )
    frames = wire.split(delimiter)
    row = int(rng.integers(len(frames)))
    content = unpack(frames[row])
    if not content:
        # No frame of this protocol: numbers, or lines of text.
        at = int(rng.integers(len(wire) + 1)) & ~3
        if rng.random() < 0.5:
            return wire[:at] + _special(4, rng) + wire[at + 4 :]
        return damage_text(wire, rng)
    new = damage_bytes(content, rng)[:4000].ljust(8, b"\0")
    return delimiter.join([*frames[:row], pack(new).strip(delimiter), *frames[row + 1 :]])


def _content_of_cobs(body: bytes) -> bytes | None:
    """Return the content of a frame of locatk without its CRC-16, or None if it is none."""
    out = bytearray()
    at = 0
    while at < len(body):
        code = body[at]
        out += body[at + 1 : at + code]
        at += code
        if code < 255 and at < len(body):
            out.append(0)
    content = bytes(out[:-2])
    is_frame = 8 <= len(content) <= 256 and encode_frame(content).strip(b"\0") == body
    return content if is_frame else None


# ---- compressed formats


def damage_pdf(data: bytes, rng: Rng) -> bytes:
    """Damage a stream before it is compressed, or the document."""
    streams = list(re.finditer(rb"stream\r?\n(.*?)\r?\nendstream", data, re.DOTALL))
    if streams and rng.random() < 0.6:
        place = streams[int(rng.integers(len(streams)))]
        content = place.group(1)
        try:
            content = zlib.compress(damage_text(zlib.decompress(content), rng))
        except zlib.error:
            content = damage_bytes(content, rng)
        return data[: place.start(1)] + content + data[place.end(1) :]
    return damage_text(data, rng) if rng.random() < 0.5 else damage_bytes(data, rng)


def damage_png(data: bytes, rng: Rng) -> bytes:
    """Damage the content of a chunk and give it the right checksum, or damage the bytes."""
    if rng.random() < 0.3:
        return damage_bytes(data, rng)
    chunks, at = [], 8
    while at + 12 <= len(data):
        (size,) = struct.unpack(">I", data[at : at + 4])
        chunks.append([data[at + 4 : at + 8], data[at + 8 : at + 8 + size]])
        at += 12 + size
    part = chunks[int(rng.integers(len(chunks)))]
    if part[0] == b"IHDR" and rng.random() < 0.7:
        at = int(choose(rng, (0, 4)))  # type: ignore[call-overload]
        side = int(choose(rng, (0, 1, 7, 20_000, 60_000, 2**31 - 1, 2**32 - 1)))  # type: ignore[call-overload]
        part[1] = part[1][:at] + struct.pack(">I", side) + part[1][at + 4 :]
    else:
        part[1] = damage_bytes(part[1], rng)
    return data[:8] + b"".join(
        struct.pack(">I", len(c)) + kind + c + struct.pack(">I", zlib.crc32(kind + c))
        for kind, c in chunks
    )
