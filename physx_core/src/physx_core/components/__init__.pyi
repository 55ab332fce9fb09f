"""Base classes of the components that plugins implement and pipelines use."""

from .buffer import BatchSelection as BatchSelection
from .buffer import Buffer as Buffer
from .environment import Environment as Environment
from .environment import options_of as options_of
from .evaluation import Evaluation as Evaluation
from .group import Group as Group
from .launcher import ClientHandle as ClientHandle
from .launcher import Launcher as Launcher
from .network import Network as Network
from .optimization import Optimization as Optimization
from .parameter import Parameter as Parameter
from .predicted_batch import PredictedBatch as PredictedBatch
from .sampler import LearningSampler as LearningSampler
from .sampler import Sampler as Sampler
from .sampler import checked as checked
from .scene.colors import map_values as map_values
from .scene.colors import parse_color as parse_color
from .scene.event import Event as Event
from .scene.factory import Factory as Factory
from .scene.geometry import vertex_normals as vertex_normals
from .scene.kinds import KINDS as KINDS
from .services import Services as Services
from .transformation import Transformation as Transformation
from .visualizer import Observer as Observer
from .visualizer import Visualizer as Visualizer
