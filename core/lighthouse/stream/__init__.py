"""Causal localization by Lighthouse: sweeps in, fixes out.

Re-exports the stream. :mod:`.photodiodes` locates single photodiodes, :mod:`.rigid` devices of
several; both share the stations of a :mod:`.known_scene`. :mod:`.supervision` watches the stations,
and :mod:`.scene_search` estimates a scene from the first sweeps if none is given.
"""

from locatk.core.lighthouse.stream.solver import LighthouseStream

__all__ = ["LighthouseStream"]
