"""Environments in other processes: serving them, and driving those that others serve."""

from .endpoints import connect as connect
from .endpoints import connect_vector as connect_vector
from .endpoints import serve as serve
from .godot_gym.client import GodotGymClient as GodotGymClient
from .godot_gym.client import GodotGymEnv as GodotGymEnv
from .godot_gym.communication import Communication as Communication
from .godot_gym.environment import RLEnvironment as RLEnvironment
from .godot_gym.frames_timer import PhysicsFramesTimer as PhysicsFramesTimer
from .godot_gym.messages import Messages as Messages
from .godot_gym.messages import fill as fill
from .godot_gym.parts import RLAgent as RLAgent
from .godot_gym.parts import RLEnvWorld as RLEnvWorld
from .godot_rl.client import GodotRLEnv as GodotRLEnv
from .godot_rl.client import GodotRLVectorEnv as GodotRLVectorEnv
from .godot_rl.launch import write_launcher as write_launcher
from .physx.client import PhysxClient as PhysxClient
from .physx.client import PhysxEnv as PhysxEnv
from .physx.observer import PhysxObserver as PhysxObserver
from .physx.vector_env import PhysxVectorEnv as PhysxVectorEnv
from .serving.connection import RequestConnection as RequestConnection
from .serving.protocol import Protocol as Protocol
from .serving.sample_env import SampleEnv as SampleEnv
from .serving.service import Service as Service
from .serving.socket_service import SocketService as SocketService
from .serving.worlds import Worlds as Worlds
from .serving.worlds import open_worlds as open_worlds
