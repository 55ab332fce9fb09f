"""A visualizer as a plugin: `matplotlib/matplotlib` saves a picture of what each instance drew."""

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from physx_core import Visualizer
from physx_core.plugins import hookimpl

CORNERS = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])


class MatplotlibVisualizer(Visualizer):
    def __init__(self, size=(640, 480)):
        self.size, self.runs, self.scenes, self.files = size, 0, {}, []

    def open(self, run_name, session_dir, instance_nb):
        self.runs += 1
        name = run_name if self.runs == 1 else f"{run_name}_{self.runs}"
        self.path, self.scenes, self.files = session_dir / f"{name}.png", {}, []
        self.count = instance_nb

    def events(self, instance_id, step, events):
        scene = self.scenes.setdefault(instance_id, {})
        for event in (one for several in events for one in several.each()):
            if event.action == "remove":
                scene.pop(event.name)
            elif event.action == "add":
                scene[event.name] = (event.kind, dict(event.values))
            elif event.name in scene:  # the simulated time is not
                scene[event.name][1].update(event.values)

    def figure(self):
        figure = Figure([length / 100 for length in self.size], dpi=100, layout="constrained")
        for number, (instance, scene) in enumerate(sorted(self.scenes.items()), 1):
            axes = figure.add_subplot(1, len(self.scenes), number, projection="3d")
            axes.set_title(f"instance {instance}")
            for kind, values in scene.values():
                color = values.get("color")
                if kind == "lines":
                    for line in values["positions"]:
                        axes.plot(*np.transpose(line), color=color, lw=2)
                elif points := self.points(kind, values):
                    axes.scatter(*np.concatenate(points).T, s=9, color=color)
            axes.set_aspect("equal")
        return figure

    def points(self, kind, values):
        position = values.get("position", np.zeros(3))
        if kind in ("sphere", "capsule", "cylinder"):
            return [position + values["radius"] * CORNERS]
        if kind == "box":
            return [position + values["half_sizes"] * CORNERS]
        if kind == "robot":
            return [values["poses"][:, :3]] if "poses" in values else []
        return [values["positions"]] if "positions" in values else []

    def capture(self):
        if not self.scenes:
            return None
        canvas = FigureCanvasAgg(self.figure())
        canvas.draw()
        return np.asarray(canvas.buffer_rgba())[:, :, :3].copy()

    def close(self):
        if self.scenes:
            self.figure().savefig(self.path)
            self.files, self.scenes = [f"picture: {self.path}"], {}

    def outputs(self):
        return self.files


@hookimpl
def physx_visualizers():
    return {"matplotlib": MatplotlibVisualizer}
