"""Demodulation of Lighthouse V2: from edges or samples of infrared light to sweeps.

Recordings of edges are demodulated by :func:`demodulate_recording`, windows of samples by
:func:`read_windows`. Syncs of a tracker are evaluated by :mod:`.tracker_syncs`, and the slow bits
of a base station by :mod:`.ootx`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from locatk.core.lighthouse.demodulation.identification import (
        SequenceMatches,
        WindowMatches,
        false_match_probability,
        read_windows,
    )
    from locatk.core.lighthouse.demodulation.pipeline import (
        DecodedSweeps,
        DemodulatedRecording,
        demodulate_recording,
    )

__all__ = [
    "DecodedSweeps",
    "DemodulatedRecording",
    "SequenceMatches",
    "WindowMatches",
    "demodulate_recording",
    "false_match_probability",
    "read_windows",
]

_PIPELINE_NAMES = ("DecodedSweeps", "DemodulatedRecording", "demodulate_recording")


def __getattr__(name: str) -> Any:
    # The pipeline imports scipy, which an import of `ootx` alone should not cost.
    if name in _PIPELINE_NAMES:
        from locatk.core.lighthouse.demodulation import pipeline

        return getattr(pipeline, name)
    if name in __all__:
        from locatk.core.lighthouse.demodulation import identification

        return getattr(identification, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
