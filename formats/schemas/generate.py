"""Generate ``*_pb2.py`` and ``*_pb2.pyi`` from the ``.proto`` files beside this script.

Examples
--------
::

    python formats/schemas/generate.py           # write the code
    python formats/schemas/generate.py --check   # exit with 1 if it is not up to date

Needs grpcio-tools, which brings its own protoc. Checking takes any release of it.
Generating takes the one below: generated code refuses to run with a protobuf older
than its protoc, so a newer one would raise the lower bound of the dependency.
"""

from __future__ import annotations

import ast
import importlib.resources
import re
import sys
import tempfile
from pathlib import Path

HERE = Path(__file__).resolve().parent
PROTOC, GRPCIO_TOOLS = "6.30.0", "1.72.1"
"""Release of protobuf that the code is made for, and of grpcio-tools that holds it."""


def generate(target: Path) -> list[Path]:
    """Generate all code into the folder ``target`` and return the files written.

    The schemas are compiled under the name ``locatk/<file>.proto``: protobuf keeps
    one table of file names a process, in which ``poses.proto`` might meet another.
    """
    from grpc_tools import protoc  # type: ignore[import-untyped]

    well_known = str(importlib.resources.files("grpc_tools") / "_proto")
    names = sorted(path.name for path in HERE.glob("*.proto"))
    with tempfile.TemporaryDirectory() as folder:
        options = [f"-Ilocatk={HERE}", f"-I{well_known}"]
        options += [f"--python_out={folder}", f"--pyi_out={folder}"]
        if protoc.main(["protoc", *options, *(f"locatk/{name}" for name in names)]) != 0:
            raise SystemExit("protoc failed")
        written = []
        for made in sorted(Path(folder, "locatk").iterdir()):
            path = target / made.name
            path.write_bytes(made.read_bytes())
            written.append(path)
    return written


def _version(code: str) -> str | None:
    found = re.search(r"^# Protobuf Python Version: (\S+)$", code, re.MULTILINE)
    return found[1] if found else None


def _descriptor(code: str) -> bytes | None:
    """The serialized schema inside generated code: all that it means."""
    found = re.search(r"AddSerializedFile\((b(['\"]).*?(?<!\\)\2)\)", code, re.DOTALL)
    return ast.literal_eval(found[1]) if found else None


def stale() -> list[str]:
    """Names of committed files that are missing, superfluous or not what protoc makes.

    Another release of protoc words the same schema differently: then the schemas
    inside are compared, not the text around them.
    """
    with tempfile.TemporaryDirectory() as folder:
        fresh = {path.name: path.read_text("utf-8") for path in generate(Path(folder))}
    committed = {path.name: path.read_text("utf-8") for path in HERE.glob("*_pb2.py*")}
    bad = sorted(fresh.keys() ^ committed.keys())
    for name in sorted(fresh.keys() & committed.keys()):
        code = name.removesuffix("i")
        same_protoc = _version(fresh[code]) == _version(committed.get(code, ""))
        if same_protoc:
            if fresh[name] != committed[name]:
                bad.append(name)
        elif name == code and _descriptor(fresh[name]) != _descriptor(committed[name]):
            bad.append(name)
    return bad


def main(arguments: list[str]) -> int:
    """Generate, or with ``--check`` compare; returns the exit status."""
    if arguments not in ([], ["--check"]):
        print("usage: generate.py [--check]", file=sys.stderr)
        return 2
    if arguments:
        bad = stale()
        for name in bad:
            print(f"{name} is not up to date: run {Path(__file__).name}", file=sys.stderr)
        return 1 if bad else 0
    with tempfile.TemporaryDirectory() as folder:
        made = generate(Path(folder))
        version = _version(next(p for p in made if p.suffix == ".py").read_text("utf-8"))
        if version != PROTOC:
            print(
                f"protoc is of protobuf {version}, not {PROTOC}: pip install "
                f"grpcio-tools=={GRPCIO_TOOLS} in an environment of its own",
                file=sys.stderr,
            )
            return 1
    for path in generate(HERE):
        print(path.relative_to(HERE))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
