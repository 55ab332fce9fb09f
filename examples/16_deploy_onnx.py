"""A trained network as one file that runs without physx or PyTorch.

The file includes the normalization, so it takes and returns physical units under the names of the
fields. A program that imports only NumPy and onnxruntime predicts with it, as one in C++ or on a
robot would: its predictions equal those of physx up to rounding, and single samples are faster.

    python examples/16_deploy_onnx.py
    physx export-network sessions/cloud/networks/training --to onnx
"""

from __future__ import annotations

import subprocess
import sys
import time

import numpy as np
from common import generate, options, samples, trained
from environments.cloud import Cloud, network
from matplotlib.figure import Figure

PROGRAM = """
import sys, time
import numpy as np
import onnxruntime

file, clouds, guesses = sys.argv[1:]
options = onnxruntime.SessionOptions()
options.intra_op_num_threads = 1
model = onnxruntime.InferenceSession(file, options, providers=["CPUExecutionProvider"])
points = np.load(clouds)
np.save(guesses, model.run(["prediction"], {"input": points})[0])
begin = time.perf_counter()
for cloud in points[:200]:
    model.run(["prediction"], {"input": cloud[None]})
took = (time.perf_counter() - begin) / len(points[:200])
loaded = {"torch", "physx_core", "physx_torch"} & set(sys.modules)
print(f"onnxruntime: {1e6 * took:7.1f} µs per cloud; loaded of physx and PyTorch: {loaded or None}")
sys.exit(bool(loaded))
"""


def draw(path, right, ours, theirs) -> None:
    figure = Figure(figsize=(9, 3.4), layout="constrained")
    said, apart = figure.subplots(1, 2)
    said.plot(right, theirs, ".", [0, 1.8], [0, 1.8], "k", ms=2, lw=0.8)
    said.set(xlabel="spread in m", ylabel="what the file says, in m")
    apart.hist((theirs - ours).ravel(), bins=60)
    apart.set(xlabel="onnxruntime minus physx, in m", ylabel="guesses", yscale="log")
    figure.savefig(path)


def main() -> int:
    asked = options(__doc__).parse_args()
    rows, epochs = (500, 2) if asked.small else (20_000, 8)
    stored = generate(Cloud, rows, asked.session_dir, as_tcp_ip_client=False)
    clouds, right = samples(stored, "validation", "input", "ground_truth")
    learner = trained(stored, network(), epochs, seed=0, batch_size=64).learner
    ours = learner.predict_in_training({"input": clouds})["prediction"]
    begin = time.perf_counter()
    for cloud in clouds[:200]:
        learner.predict_in_training({"input": cloud[None]})
    took = (time.perf_counter() - begin) / len(clouds[:200])

    files = [stored / name for name in ("spread.onnx", "clouds.npy", "guesses.npy")]
    learner.export(files[0], "onnx")
    np.save(files[1], clouds.astype(np.float32))
    print(f"physx:       {1e6 * took:7.1f} µs per cloud", flush=True)
    subprocess.run([sys.executable, "-c", PROGRAM, *map(str, files)], check=True)
    theirs = np.load(files[2])
    apart = np.abs(theirs - ours).max()
    print(f"greatest difference of {len(clouds)} guesses: {apart:.1e} m")
    if asked.picture:
        draw(asked.picture, right, ours, theirs)
    return int(apart > 1e-5)


if __name__ == "__main__":
    sys.exit(main())
