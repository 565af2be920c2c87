"""The paper's sensing pipeline as written, for comparison (Polaris section 6.2)."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import InputError
from locatk.core.magnetics import dipole_tensor
from locatk.core.polaris import ddtw
from locatk.core.polaris.array import Samples
from locatk.core.polaris.peaks import Peak, Signals, find_peaks, signals
from locatk.core.polaris.sighting import Sighting
from locatk.core.polaris.tag import Tags
from locatk.core.polaris.templates import Templates, template_set

Array = NDArray[np.float64]
SMOOTHING=0.25
WINDOW=1.0
PAIR=True
HIST=None
def stronger(i, ds, A): return ds[max(ds,key=lambda k:A[k])]
def authors(i, ds, A):
    if len(ds)==1: return list(ds.values())[0]
    return ds[i-1] if A[i-1]>A[i+1]-15e-6 else ds[i+1]
def authors_mirror(i, ds, A):
    if len(ds)==1: return list(ds.values())[0]
    return ds[i+1] if A[i+1]>A[i-1]-15e-6 else ds[i-1]
def difference(i, ds, A): return sum(ds.values())
def least(i, ds, A):
    f=[v for v in ds.values() if abs(v)>0]
    return min(f,key=abs) if f else 0.0
RULE=stronger

def lateral(ratio, angle, apart, height):
    d = np.linspace(0.0, apart, 401)
    g = gain(d, angle, height) / gain(d - apart, angle, height)   # falls with d
    return float(np.interp(-ratio, -g, d))

def gain(off, angle, height):
    sensor = np.stack([np.zeros_like(off), off, np.full_like(off, height)], -1)
    return np.linalg.norm(dipole_tensor(sensor) @ np.array([math.cos(angle), math.sin(angle), 0.0]), axis=-1)

def magnets(samples, tags, speed_mps, window=None):
    window = window or WINDOW
    t = (samples.time_ns - samples.time_ns[0]) * 1e-9
    path = speed_mps * t
    step = float(np.median(np.diff(path)))
    half = tags.spacing_m / 2
    sig = signals(samples, SMOOTHING * tags.clearance_m / step)
    tmpl = template_set(tags, window=window, points=2*round(window*half/step)+1)
    slopes = ddtw.prepare(tmpl.field_t)
    raw = sig.field_t
    y = samples.array.position_m[:, 1]
    ps = []
    for p in find_peaks(sig, half / step):
        at = float(np.interp(p.at, np.arange(len(path)), path))
        if any(abs(at-b)<half and abs(y[p.sensor]-y[q.sensor])<half*1.01 for b,q in ps): continue
        ps.append((at,p))
    from itertools import product
    out=[]
    for at,p in ps:
        here=round(p.at); A=sig.amplitude_t[here]
        mates=[(b,q) for b,q in ps if abs(b-at)<half]
        taken={q.sensor for _,q in mates}
        best=None
        for choice in product((-1,1),repeat=len(mates)):
            n=[q.sensor+c for (b,q),c in zip(mates,choice)]
            if len(set(n))<len(n) or set(n)&taken or min(n)<0 or max(n)>=len(y): continue
            v=sum(sig.amplitude_t[round(q.at),k] for (b,q),k in zip(mates,n))
            if best is None or v>best[0]: best=(v,n[[q for _,q in mates].index(p)])
        i=p.sensor
        j=best[1] if best and PAIR else max([k for k in (i-1,i+1) if 0<=k<len(y)],key=lambda k:A[k])
        inside = np.abs(path - at) <= half * window
        cost = ddtw.distances(raw[inside, i], slopes)
        bt = int(cost.argmin()); ang=tmpl.angle_rad[bt]
        u=lateral(A[i]/A[j],ang,abs(y[j]-y[i]),tags.clearance_m)*np.sign(y[j]-y[i])
        out.append((np.array([at,y[i]+u]),ang,p,u,tmpl.lateral_m[bt]))
    return out
