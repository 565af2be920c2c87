"""receiver.toml: exact round trips, strict checks, attachments of sessions, and the deck."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from locatk.core.errors import ArtifactError
from locatk.core.lighthouse.receiver import DECK, Receiver
from locatk.core.lighthouse.recording import Sweeps
from locatk.formats.artifacts import receiver as receivers
from locatk.formats.artifacts.receiver import dumps_receiver, loads_receiver
from locatk.formats.capture.attachments import attachments
from locatk.formats.sessions import observations
from locatk.formats.sessions.reader import Session
from locatk.formats.sessions.writer import SessionWriter

# ---- the file


@st.composite
def receiver(draw: st.DrawFn) -> Receiver:
    count = draw(st.integers(1, 6))
    coordinates = st.floats(-2.0, 2.0)
    places = draw(
        st.lists(st.tuples(coordinates, coordinates, coordinates), min_size=count, max_size=count)
    )
    position = np.array(places) + np.arange(count)[:, None] * 10.0  # no two at one place
    normal = None
    if draw(st.booleans()):
        turn = np.array(draw(st.lists(st.floats(-9, 9), min_size=2 * count, max_size=2 * count)))
        a, b = turn.reshape(2, count)
        normal = np.column_stack([np.cos(a) * np.cos(b), np.sin(a) * np.cos(b), np.sin(b)])
    return Receiver(position, normal, draw(st.text(max_size=5)))


def same(one: Receiver, other: Receiver) -> bool:
    normals = [None if each.normal is None else each.normal.tolist() for each in (one, other)]
    places = [each.position_m.tolist() for each in (one, other)]
    return (one.name, normals[0], places[0]) == (other.name, normals[1], places[1])


@pytest.mark.slow
@settings(max_examples=40, deadline=None)
@given(receiver())
def test_every_receiver_comes_back_to_the_last_bit(found: Receiver) -> None:
    text = dumps_receiver(found)
    assert same(loads_receiver(text), found)
    assert dumps_receiver(loads_receiver(text)) == text


HEAD = 'format = "locatk-lighthouse-receiver"\nformat_version = 1\n'
TWO = HEAD + "position_mm = [[0, 0, 0], [30, 0, 5.5]]\n"


def test_a_receiver_by_hand() -> None:
    found = loads_receiver(TWO + "normal = [[0, 0, 1], [0, 0.7071, 0.7071]]")
    assert found.position_m.tolist() == [[0, 0, 0], [0.03, 0, 0.0055]]
    assert found.normal is not None
    assert found.name == ""


def test_the_example_of_the_documentation(root: Path) -> None:
    text = (root / "docs" / "formats.md").read_text("utf-8")
    example = text.split("## receiver.toml")[1].split("```toml\n")[1].split("```")[0]
    assert same(loads_receiver(example), DECK)


@pytest.mark.parametrize(
    ("text", "where", "words"),
    [
        (TWO.replace("receiver", "deck"), "format", "expected 'locatk-lighthouse-receiver'"),
        (HEAD, None, "missing key 'position_mm'"),
        (HEAD + "position_mm = []", "position_mm", "1 to 1000 rows of 3 numbers in mm"),
        (HEAD + "position_mm = 3", "position_mm", "1 to 1000 rows of 3 numbers in mm"),
        (
            HEAD + f"position_mm = [{'[1, 2, 3],' * 1001}]",
            "position_mm",
            "1 to 1000 rows of 3 numbers in mm",
        ),
        (TWO.replace(", 5.5", ""), "position_mm[1]", "list of 3 numbers"),
        (HEAD + "position_mm = [[0, 0, nan]]", "position_mm[0][2]", "finite"),
        (TWO.replace("30, 0, 5.5", "0.0, 0, 0"), "position_mm", "position of sensor 0"),
        (TWO + "normal = [[0, 0, 1]]", "normal", "2 rows of 3"),
        (TWO + "normal = [[0, 0, 1], [0, 1, 1]]", "normal[1]", "length 1"),
        (TWO + "normal = [[0, 0, 0], [0, 1, 1]]", "normal[0]", "length 1"),
        (TWO + "normal = [[0, 1e10, 0], [0, 1, 1]]", "normal[0]", "length 1"),
        (TWO + "name = 3", "name", "a string"),
        (TWO + "normals = 3", None, "unknown key 'normals'"),
    ],
)
def test_errors_name_key_and_expected_value(
    refused: Callable[..., None], text: str, where: str | None, words: str
) -> None:
    refused(receivers.RECEIVER, text, where, words)


@pytest.mark.slow
@settings(max_examples=60, deadline=None)
@given(st.data())
def test_damaged_text_is_refused_or_read(data: st.DataObject) -> None:
    text = bytearray(dumps_receiver(DECK).encode())
    for _ in range(data.draw(st.integers(1, 4))):
        place = data.draw(st.integers(0, len(text) - 1))
        if data.draw(st.booleans()):
            text[place] = data.draw(st.integers(0, 255))
        else:
            del text[place : place + data.draw(st.integers(1, 40))]
            text = text or bytearray(b"x")
    try:
        found = loads_receiver(bytes(text))
    except ArtifactError:
        return
    assert found.position_m.shape == (len(found), 3)
    assert np.isfinite(found.position_m).all()


# ---- sessions

WAND = Receiver(np.array([[0.0, 0.0, 0.0], [0.1, 0.0, 0.0]]), name="wand")


def sweeps(*devices: str) -> Sweeps:
    n = 6
    return Sweeps(
        devices=devices,
        time_ns=1_700_000_000_000_000_000 + 20_000_000 * np.arange(n),
        device=np.arange(n, dtype=np.int32) % len(devices),
        sensor=np.zeros(n, np.int32),
        channel=np.ones(n, np.int32),
        polynomial=np.full(n, -1, np.int32),
        sweep=np.full(n, -1, np.int32),
        count=40_000.0 + np.arange(n),
    )


def write(path: Path, found: dict[str, Receiver], devices: tuple[str, ...]) -> Session:
    observations.write_session(
        path, system="lighthouse", sweeps=sweeps(*devices), receivers=found, overwrite=True
    )
    return Session.open(path)


@pytest.mark.parametrize(
    ("found", "names"),
    [
        ({}, []),
        ({"a": DECK, "b/c": DECK}, ["receiver.toml"]),
        ({"a": DECK, "b/c": WAND}, ["receiver-a.toml", "receiver-b/c.toml"]),
        # One file for all would give it to the other as well.
        ({"a": DECK}, ["receiver-a.toml"]),
        # Known, though it has seen nothing.
        ({"a": DECK, "b/c": DECK, "d": DECK}, [f"receiver-{d}.toml" for d in ("a", "b/c", "d")]),
    ],
)
def test_each_device_has_its_receiver(
    tmp_path: Path, found: dict[str, Receiver], names: list[str]
) -> None:
    session = write(tmp_path / "run.mcap", found, ("a", "b/c"))
    assert [info.name for info in session.attachments()] == names
    read = observations.read_receivers(session)
    assert read.keys() == found.keys()
    assert all(same(read[device], found[device]) for device in found)
    if names:
        again = attachments([Path(session.path)])  # as `locatk capture --artifact` takes them
        assert sorted(again) == names


def test_invalid_receivers_are_not_written(tmp_path: Path) -> None:
    dark = Receiver(np.zeros((1, 3)), np.zeros((1, 3)))
    with pytest.raises(ArtifactError, match="length 1") as caught:
        write(tmp_path / "run.mcap", {"a": dark}, ("a",))
    assert caught.value.file == "receiver-a.toml"
    assert list(tmp_path.iterdir()) == []


def recorded(path: Path, device: str, *attached: Receiver) -> Session:
    plain = write(path.with_name("plain.mcap"), {}, ("robot",))
    with SessionWriter(path, system="lighthouse") as writer:
        writer.metadata("capture", {"device": device})
        for each in attached:
            writer.attach_toml("receiver.toml", dumps_receiver(each))
        from locatk.formats.schemas.lighthouse_pb2 import LighthouseSweep

        for time_ns, message in plain.decoded("/lighthouse/robot", LighthouseSweep):
            writer.write("/lighthouse/robot", message, time_ns)
    return Session.open(path)


def test_recordings_of_a_deck_have_its_receiver(tmp_path: Path) -> None:
    """Recordings of earlier versions have no attachment."""
    old = observations.read_receivers(recorded(tmp_path / "1.mcap", "lighthouse-deck"))
    assert [*old] == ["robot"]
    assert same(old["robot"], DECK)
    assert observations.read_receivers(recorded(tmp_path / "2.mcap", "dotbot-gateway")) == {}
    given = observations.read_receivers(recorded(tmp_path / "3.mcap", "lighthouse-deck", WAND))
    assert same(given["robot"], WAND)
    [(name, text)] = receivers.deck_artifacts(SimpleNamespace(kind="lighthouse", sensors=4)).items()
    assert name == "receiver.toml"
    assert same(loads_receiver(text), DECK)
