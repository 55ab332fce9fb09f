"""physx plugin `rerun`: shows environments and training in the Rerun viewer."""

from .viewer.headless import render_picture as render_picture
from .visualizer import RerunVisualizer as RerunVisualizer
