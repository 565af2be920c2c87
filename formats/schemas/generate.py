"""Generate ``*_pb2.py`` and ``*_pb2.pyi`` from the ``.proto`` files in the folder of this script.

Examples
--------
::

    python formats/schemas/generate.py           # write the code
    python formats/schemas/generate.py --check   # exit with 1 if it is not up to date

grpcio-tools is required, which contains protoc. The check works with any release. Generation
needs the release below: generated code does not run with a protobuf older than its protoc, so a
newer release would raise the lower bound of the dependency.
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
"""Release of protobuf for which the code is generated, and of grpcio-tools that contains it."""


def generate(target: Path) -> list[Path]:
    """Generate all code into the folder ``target`` and return the files written.

    The schemas are compiled under the name ``locatk/<file>.proto``. Protobuf has one table of
    file names per process, which may contain another ``poses.proto``.
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
        for generated in sorted(Path(folder, "locatk").iterdir()):
            path = target / generated.name
            path.write_bytes(generated.read_bytes())
            written.append(path)
    return written


def _version(code: str) -> str | None:
    match = re.search(r"^# Protobuf Python Version: (\S+)$", code, re.MULTILINE)
    return match[1] if match else None


def _descriptor(code: str) -> bytes | None:
    """Return the serialized schema in generated code, which determines its meaning."""
    match = re.search(r"AddSerializedFile\((b(['\"]).*?(?<!\\)\2)\)", code, re.DOTALL)
    return ast.literal_eval(match[1]) if match else None


def stale() -> list[str]:
    """Return the names of committed files that are missing, superfluous or out of date.

    Releases of protoc generate different code for the same schema: if the release differs, only
    the schemas in the code are compared.
    """
    with tempfile.TemporaryDirectory() as folder:
        fresh = {path.name: path.read_text("utf-8") for path in generate(Path(folder))}
    committed = {path.name: path.read_text("utf-8") for path in HERE.glob("*_pb2.py*")}
    stale_names = sorted(fresh.keys() ^ committed.keys())
    for name in sorted(fresh.keys() & committed.keys()):
        code = name.removesuffix("i")
        same_protoc = _version(fresh[code]) == _version(committed.get(code, ""))
        if same_protoc:
            if fresh[name] != committed[name]:
                stale_names.append(name)
        elif name == code and _descriptor(fresh[name]) != _descriptor(committed[name]):
            stale_names.append(name)
    return stale_names


def main(arguments: list[str]) -> int:
    """Generate the code, or compare it with ``--check``; return the exit status."""
    if arguments not in ([], ["--check"]):
        print("usage: generate.py [--check]", file=sys.stderr)
        return 2
    if arguments:
        stale_names = stale()
        for name in stale_names:
            print(f"{name} is not up to date: run {Path(__file__).name}", file=sys.stderr)
        return 1 if stale_names else 0
    with tempfile.TemporaryDirectory() as folder:
        generated = generate(Path(folder))
        version = _version(next(p for p in generated if p.suffix == ".py").read_text("utf-8"))
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
