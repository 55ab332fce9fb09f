"""The physx plugin ``rerun``: shows environments and training in the Rerun viewer."""

from .notebook import show as show
from .version import __version__ as __version__
from .viewer.headless import render_film as render_film
from .viewer.headless import render_picture as render_picture
from .visualizer import RerunVisualizer as RerunVisualizer
