"""A data scientist has fifty recordings, and wants one table of poses and one of errors.

Until now: fifty calls of a shell. Here: a loop in Python, or one command for the folder.
"""

import subprocess
from pathlib import Path

import pandas as pd

import locatk

# The recordings. Usually they are there already.
folder = Path("sessions")
folder.mkdir()
for seed in range(1, 51):
    settings = {"robots": {"count": 2, "duration_s": 5.0}}
    locatk.simulate("lighthouse", folder / f"run-{seed}.mcap", settings, seed=seed)

# One by one in Python: the poses as one table, the errors of two methods as another.
poses, errors = [], []
for path in sorted(folder.glob("*.mcap"))[:5]:
    session = locatk.open(path)
    for method in ("bundle", "paper"):
        solution = locatk.solve(session, method=method)
        poses.append(solution.to_dataframe().assign(session=path.stem, method=method))
        ape = locatk.evaluate(solution, session).ape_translation
        assert ape is not None
        errors.append({"session": path.stem, "method": method, "median_mm": 1e3 * ape.median})
table = pd.concat(poses)
medians = pd.DataFrame(errors).pivot(index="session", columns="method", values="median_mm")
print(medians.round(2))
assert set(table.columns) >= {"time", "device", "x_m", "y_m", "sigma_x_m"}
assert len(medians) == 5
assert medians["bundle"].median() < 3.0
assert len(repr(solution)) < 200

# All of them by one command each: solved on all cores, one table of poses, one of errors.
for command in (
    "locatk solve sessions -o solved -q",
    "locatk export solved -o poses.parquet",
    "locatk eval solved --truth sessions --table errors.csv",
    "locatk report solved --truth sessions -o overview.html",
):
    subprocess.run(command.split(), check=True)
poses_of_all = pd.read_parquet("poses.parquet")
errors_of_all = pd.read_csv("errors.csv")
assert poses_of_all["session"].nunique() == errors_of_all["session"].nunique() == 50
assert len(errors_of_all) == 100
assert 1e3 * errors_of_all["median_m"].median() < 3.0
print(f"{len(poses_of_all)} poses of 50 sessions in one table")
