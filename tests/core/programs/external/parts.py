"""A program of four processes, each of which has a part of a field, one of them none of it.

parts.py WAY: they may break in many ways.
"""

import os
import sys
import time

import physx

way, rank, ranks = sys.argv[1], int(os.environ["RANK"]), 4
begin, end = [(7, 10), (0, 3), (3, 7), (10, 10)][rank]

if rank == 2:
    if way == "overlap":
        begin -= 1
    if way == "gap":
        begin += 2
    if way == "missing":
        time.sleep(60)
    if way == "twice":
        rank = 1
    if way == "negative":
        begin = -1
    if way == "number":
        ranks = 5


def part(scale, step):
    return [[scale * i, float(step)] for i in range(begin, end)]


fields = {
    "u": physx.Array("float64", (end - begin, 2)),
    "predicted": physx.Array("float64", (end - begin, 2)),
}
if rank == 0 or way == "scalar":
    fields["t"] = 0.0
if rank == 2 and way == "type":
    fields["u"] = physx.Array("float32", (end - begin, 2))
if rank == 2 and way == "axes":
    fields["u"] = physx.Array("float64", (end - begin, 3))

run = physx.Run(fields, rank=rank, ranks=ranks, offsets={"u": begin, "predicted": begin})
given = run.parameters(scale=0.0)
for step in range(3):
    u = part(given["scale"], step)
    sample = {"u": u, "predicted": [[0.0, 0.0]] * len(u)}
    if way == "ask":
        sample["predicted"] = run.predict({"u": u}, {"predicted": fields["predicted"]})["predicted"]
    if way == "ask alone":  # the others make the same call, for nothing
        asked = ({"t": 1.0}, {"v": 0.0}) if rank == 1 else ({}, {})
        assert rank != 1 or run.predict(*asked) == {"v": 0.5}
        assert rank == 1 or run.predict(*asked) == {}
    if rank == 0:
        sample["t"] = float(step)
    if rank == 2 and step == 1:
        if way == "other call":
            break
        if way == "size":
            sample["u"] = u[1:]
        if way == "left out":
            del sample["u"]
        if way == "one more":
            sample["t"] = 0.0
        if way == "dies":
            sys.exit(3)
        if way == "hangs":
            time.sleep(60)
    run.send(**sample)
run.close()
