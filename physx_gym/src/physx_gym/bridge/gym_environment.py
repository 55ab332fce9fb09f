"""Any Gymnasium environment as a physx environment that stores its transitions."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np

from physx_core import Field, Parameter
from physx_core.components import Environment, set_number
from physx_core.errors import ConfigError
from physx_core.plugins import import_component
from physx_core.typing import Array
from physx_gym.bridge.make_env import make_env
from physx_gym.bridge.policy import single_action
from physx_gym.spaces import SpaceFields

_PICTURE = "picture"


class GymEnvironment(Environment):
    """Stores the transitions of a Gymnasium environment, as in ``"gym/CartPole-v1"``.

    One sample is one transition: ``observation``, ``action``, ``reward``, ``next_observation``,
    ``terminated`` and ``truncated``. A space of several parts has a field for each, for example
    ``observation_states_agent_q``. Episodes are trajectories: `Dataset.episodes` returns them. When
    stored samples are loaded, their actions are replayed. Episodes are independent if the
    environment has a time limit and no network acts, or if the configuration says so: ``reset``
    gets a seed for each then, and not only for the first.
    """

    def __init__(
        self, *, id: str, policy: str | Callable[..., Any] = "random", **kwargs: Any
    ) -> None:
        """Store the arguments of the environment.

        Args:
            id: Its id in Gymnasium, or where it is: see `make_env`.
            policy: What chooses the actions: ``"random"`` samples the action space; ``"network"``
                is the network of the run; ``"package.module:function"`` is called with the
                observation; ``"FILE.h5"``, a log of a robot, repeats its episode.
            kwargs: Arguments of `Environment`; all others go to the Gymnasium environment.
        """
        own = {
            name: kwargs.pop(name)
            for name in ("instance_id", "instance_nb", "seed")
            if name in kwargs
        }
        super().__init__(**own)
        self._id, self._options, self._policy = id, kwargs, policy
        self._observation: Any = None

    def create(self) -> None:
        """Create the environment.

        Raises:
            ConfigError: If there is no such environment or policy, or values of a space do not have
                a fixed shape.
            LogError: If the policy is a log that cannot be repeated.
        """
        self.env = make_env(self._id, self._options)
        spec = self.env.spec
        if spec is not None and spec.max_episode_steps and self._policy != "network":
            self.independent_episodes = True
        self._observations = SpaceFields(self.env.observation_space, "observation")
        self._next = SpaceFields(self.env.observation_space, "next_observation")
        self._actions = SpaceFields(self.env.action_space, "action")
        self.policy = self._policy
        if self._log is not None:
            self.independent_episodes = True  # which end with the log
        world = getattr(getattr(self.env.unwrapped, "simulator", None), "world", None)
        if world is not None and hasattr(self.env.unwrapped, "pull"):
            gravity = Parameter("gravity", -20, 20, shape=(3,), unit="m/s^2")
            names = [each.name for each in (*world.robots, *world.objects)]
            self.define_controls(gravity, names, gravity=world.gravity)
        self._draw_seeds()

    def init_database(self) -> None:
        """Define the fields of a transition."""
        self.define_training_fields(
            [
                *self._observations.fields,
                *self._actions.fields,
                Field("reward", ()),
                *self._next.fields,
                Field("terminated", (), "bool"),
                Field("truncated", (), "bool"),
            ]
        )

    def init_visualization(self) -> None:
        """Draw what the environment's ``make_drawing`` draws, or show the pictures that it renders.

        An environment that renders none is not drawn, and a warning says how to change that.
        """
        env: Any = self.env.unwrapped
        self._show: Callable[[], None]
        self._begin_episode()  # a world exists only then
        if hasattr(env, "make_drawing"):
            self.step_time = env.step_dt
            self._show = env.make_drawing(self.factory)
        elif self.env.render_mode == "rgb_array":
            self.factory.add_image(_PICTURE, self._render())
            self._show = lambda: self.factory.update_image(_PICTURE, self._render())
            return
        else:
            self._show = lambda: None
            warnings.warn(
                f"{self._id} cannot be drawn: it is not a robot of physx, and it renders no "
                'pictures. Have it render them with env_kwargs={"render_mode": "rgb_array"}, if it '
                "can (--environment.env-kwargs render_mode=rgb_array), or set no visualizer.",
                stacklevel=1,
            )
        self._show()

    def reset_parameters(self, **values: Any) -> None:
        """Prepare an independent episode, which `reset` begins with a seed of its own."""
        self._draw_seeds()
        self._observation = None

    def _draw_seeds(self) -> None:
        drawn = int(self.rng.integers(1 << 31))
        self._seed: int | None = drawn if self._log is None else self._log.seed
        self.env.action_space.seed(int(self.rng.integers(1 << 31)))

    def _begin_episode(self) -> None:
        self._observation, _ = self.env.reset(seed=self._seed)
        self._seed = None
        if self._log is not None:
            self._log.begin()

    def _render(self) -> Any:
        return self.env.render()

    def step(self) -> None:
        """Generate one transition; start a new episode after the end of the last one."""
        if self._observation is None:
            self._begin_episode()
        before = self._observations.arrays(self._observation)
        if self.sample:
            action = self._actions.value(self.sample)
        else:
            action = self._act(self._observation)
        # Copies: an environment may return the same array every time.
        sample = {name: array.copy() for name, array in before.items()}
        observation, reward, terminated, truncated, _ = self.env.step(action)
        self.set_training_data(
            **sample,
            **self._actions.arrays(action),
            **self._next.arrays(observation),
            reward=float(reward),
            terminated=bool(terminated),
            truncated=bool(truncated),
        )
        self._observation = observation
        if self.factory:
            self._show()
        if terminated or truncated or (self._log is not None and self._log.is_over()):
            self._observation = None
            if self.independent_episodes:
                self.end_episode()
            else:
                self.new_episode()

    def close(self) -> None:
        """Close the environment."""
        env: gymnasium.Env[Any, Any] | None = getattr(self, "env", None)
        if env is not None:
            env.close()

    def perturb(self, **values: Any) -> None:
        """Change the ``policy``, or what the environment's own ``perturb`` takes, or an attribute.

        Args:
            values: New values by name.

        Raises:
            UsageError: If there is no such thing, or the value does not fit.
        """
        if "policy" in values:
            self.policy = values.pop("policy")
        if self._observation is None and values:
            self._begin_episode()  # which would undo it
        if self._log is not None:
            self._log.compares = False
        env: Any = self.env.unwrapped
        if hasattr(env, "perturb"):
            env.perturb(**values)
            return
        for name, value in values.items():
            set_number(env, name, value)

    def pull(self, name: str, node: int, force: Array) -> None:
        """Pull at a robot's body or an object: see `RobotEnv.pull`."""
        if self._observation is None:
            self._begin_episode()
        if self._log is not None:
            self._log.compares = False
        env: Any = self.env.unwrapped
        env.pull(name, node, force)

    # Actions --------------------------------------------------------------------------------

    @property
    def policy(self) -> str | Callable[..., Any]:
        """What chooses the actions: see the constructor.

        Raises:
            ConfigError: If it is none, when it is set.
        """
        return self._policy

    @policy.setter
    def policy(self, policy: str | Callable[..., Any]) -> None:
        self._log: Any = None
        if policy == "random":
            space = self.env.action_space  # a snapshot of a robot leaves its random numbers out
            self._act: Callable[[Any], Any] = lambda _: space.sample()
        elif policy == "network":
            self._act = self._ask_network
        elif not isinstance(policy, str):
            self._act = policy
        elif ":" not in policy and Path(policy).suffix:
            self._act = self._log = self._logged_actions(policy)
        elif ":" not in policy:
            raise ConfigError(
                f'policy is "{policy}" but must be "random", "network", '
                '"package.module:function", or the path of a log.'
            )
        else:
            self._act = import_component("policy", policy)
        self._policy = policy

    def _logged_actions(self, path: str) -> Any:
        env: Any = self.env.unwrapped
        if not hasattr(env, "logged_actions"):
            raise ConfigError(f"policy is {path}, the log of a robot, which {self._id} is not.")
        return env.logged_actions(path)

    def _ask_network(self, observation: Any) -> Any:
        predicted = self.get_prediction(**self._observations.arrays(observation))
        batch = {name: np.asarray(values)[np.newaxis] for name, values in predicted.items()}
        return single_action(self._actions, batch)
