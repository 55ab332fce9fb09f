"""The heat equation of heat.c in Python: heat.py N STEPS EPISODES [ask] [--numpy]."""

import sys

import physx


def start(n, seed):
    numbers = []
    for _ in range(n * n):
        seed = (1103515245 * seed + 12345) % 2147483648
        numbers.append(seed / 2147483648.0)
    return [numbers[i * n : (i + 1) * n] for i in range(n)]


def advance(u, alpha):
    n = len(u)

    def at(i, j):
        return u[i][j] if 0 <= i < n and 0 <= j < n else 0.0

    def change(i, j):
        around = at(i - 1, j) + at(i + 1, j) + at(i, j - 1) + at(i, j + 1)
        return alpha * (around - 4.0 * at(i, j))

    return [[at(i, j) + change(i, j) for j in range(n)] for i in range(n)]


n, steps, episodes = map(int, sys.argv[1:4])
asks, as_array = "ask" in sys.argv, lambda values: values
if "--numpy" in sys.argv:
    import numpy

    as_array = numpy.array

u = as_array([[0.0] * n] * n)
fields = {"u": u, "next": u, "alpha": 0.0, "seed": 0, "count": physx.Array("int32")}
if asks:
    fields["predicted"] = physx.Array("float64", (n, n))
with physx.Run(fields) as run:
    for _ in range(episodes):
        given = run.parameters(alpha=0.0, seed=physx.Array("int32"))
        u = start(n, given["seed"])
        for step in range(steps):
            after = advance(u, given["alpha"])
            sample = {"u": as_array(u), "next": as_array(after), "count": step, **given}
            if asks:
                sample["predicted"] = run.predict({"u": as_array(u)}, {"next": as_array(u)})["next"]
            run.send(**sample)
            u = after
