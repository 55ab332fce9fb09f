"""Adapters for stable-baselines3: train in vector environments, save policies as sessions.

Requires the extra ``physx-gym[stable-baselines3]``; saving policies also requires `physx_torch`.
"""

from __future__ import annotations

import logging
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, cast

import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.wrappers.vector import DictInfoToList

from physx_core import Closeable, Field, NetworkConfig, Normalization, files
from physx_core.errors import ConfigError, MissingLibraryError, PhysxError, UsageError
from physx_core.pipelines import Learner

try:
    from stable_baselines3.common.base_class import BaseAlgorithm
    from stable_baselines3.common.policies import ActorCriticPolicy
    from stable_baselines3.common.preprocessing import is_image_space
    from stable_baselines3.common.torch_layers import FlattenExtractor, MlpExtractor
    from stable_baselines3.common.vec_env import VecEnv
    from torch import nn
except ImportError as error:
    raise MissingLibraryError(
        "physx_gym.stable_baselines3", "stable-baselines3", "stable-baselines3", "physx-gym"
    ) from error

__all__ = ["GymnasiumVecEnv", "save_policy"]

_LOG = logging.getLogger("physx")


class GymnasiumVecEnv(VecEnv, Closeable):
    """A Gymnasium vector environment for stable-baselines3 algorithms.

    ::

        vector = gymnasium.make_vec("physx/Ant-v0", 8, autoreset_mode="SameStep")
        model = PPO("MlpPolicy", VecMonitor(GymnasiumVecEnv(vector)))

    Steps, infos and seeds match `stable_baselines3.common.vec_env.DummyVecEnv` with the same
    environments. Wrappers of individual environments are not visible: `env_is_wrapped` is False.

    Attributes:
        vector: The vector environment.
    """

    def __init__(self, vector: VectorEnv[Any, Any, Any]) -> None:
        """Wrap a vector environment; `close` closes it.

        Args:
            vector: The vector environment. Its ``autoreset_mode`` must start a new episode in the
                step in which the last one ends.

        Raises:
            ConfigError: If it has another ``autoreset_mode``.
        """
        mode = vector.metadata.get("autoreset_mode")
        if mode is not AutoresetMode.SAME_STEP:
            raise ConfigError(
                f"stable-baselines3 starts an episode in the step in which the last one ends, but "
                f"autoreset_mode is {getattr(mode, 'value', mode)!r}: create the vector "
                'environment with autoreset_mode="SameStep", or, if Gymnasium provides it, with '
                'vector_kwargs={"autoreset_mode": gymnasium.vector.AutoresetMode.SAME_STEP}.'
            )
        self.vector: Any = vector  # Gymnasium's wrappers declare fewer methods than it has
        self._listed = DictInfoToList(vector)
        self._actions: Any = None
        super().__init__(
            vector.num_envs, vector.single_observation_space, vector.single_action_space
        )

    def reset(self) -> Any:
        """Start new episodes with the seeds and options that were set; return the observations.

        Raises:
            UsageError: If the environments' options differ.
        """
        options = self._options[0]
        if any(each != options for each in self._options):
            raise UsageError(
                "The environments of a vector environment must be reset with the same options."
            )
        seeds: Any = None if self._seeds == [None] * self.num_envs else list(self._seeds)
        seen, self.reset_infos = self._listed.reset(seed=seeds, options=options or None)
        self._reset_seeds()
        self._reset_options()
        return _copied(seen)

    def step_async(self, actions: Any) -> None:
        """Set the actions of the next step."""
        self._actions = actions

    def step_wait(self) -> Any:
        """Execute the step; return observations, rewards, ends and infos.

        Where an episode ends, the observation is the first one of the next episode, and the info is
        that of the last step, with ``"terminal_observation"``.
        """
        seen, rewards, terminated, truncated, infos = self._listed.step(self._actions)
        over = np.asarray(terminated | truncated)
        for number, info in enumerate(infos):
            if over[number]:
                self.reset_infos[number] = info
                last = info.pop("final_obs")
                infos[number] = info.pop("final_info", {}) | {"terminal_observation": last}
            cut = bool(truncated[number] and not terminated[number])
            infos[number]["TimeLimit.truncated"] = cut
        return _copied(seen), np.array(rewards, np.float32), over, infos

    def close(self) -> None:
        """Close the vector environment."""
        self.vector.close()

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """Return an attribute of the chosen environments.

        Raises:
            AttributeError: If they do not have it.
        """
        try:
            found = self.vector.get_attr(attr_name)
        except PhysxError as error:  # raised in the environment's process
            raise AttributeError(str(error)) from error
        return [found[number] for number in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Set an attribute of the chosen environments."""
        chosen = self._numbers(indices)
        rest = len(chosen) < self.num_envs
        values = self.get_attr(attr_name) if rest else [value] * self.num_envs
        for number in chosen:
            values[number] = value
        self.vector.set_attr(attr_name, values)

    def env_method(
        self, method_name: str, *method_args: Any, indices: Any = None, **method_kwargs: Any
    ) -> list[Any]:
        """Call a method of all environments; return the results.

        Raises:
            UsageError: If only some of the environments are chosen.
        """
        if len(self._numbers(indices)) < self.num_envs:
            raise UsageError(
                f"{method_name}() was requested for only some environments, but a vector "
                "environment calls it in all: omit indices, or use make_vec_env of "
                "stable-baselines3."
            )
        return list(self.vector.call(method_name, *method_args, **method_kwargs))

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
        """Return False for each environment, as their wrappers are not visible."""
        return [False for _ in self._get_indices(indices)]

    def get_images(self) -> Sequence[Any]:
        """Return each environment's rendered picture."""
        return list(self.vector.render() or ())

    def _numbers(self, indices: Iterable[int] | int | None) -> list[int]:
        """Return the numbers of the chosen environments, without duplicates."""
        return sorted({range(self.num_envs)[each] for each in self._get_indices(indices)})


def _copied(observations: Any) -> Any:
    """Return observations that the next step does not overwrite."""
    if isinstance(observations, dict):
        return {name: _copied(each) for name, each in observations.items()}
    return np.array(observations)


def save_policy(model: BaseAlgorithm, folder: str | Path) -> Path:
    """Write a policy as a session that `Policy`, ``physx evaluate`` and ``physx info`` can read.

    It predicts what ``model.predict(observation, deterministic=True)`` returns. If the model was
    trained with `VecNormalize`, the normalization of observations is saved too, but not their
    clipping (``clip_obs``): a finite bound logs a warning.

    Args:
        model: PPO, A2C or another actor-critic algorithm with an ``"MlpPolicy"``, whose observation
            is an array of numbers.
        folder: Folder of the session. Each call adds a checkpoint; the last one is read.

    Returns:
        Folder of the checkpoint.

    Raises:
        ConfigError: If the policy is of another kind.
        CheckpointError: If it cannot be stored.
    """
    space, policy, layers = model.observation_space, cast(Any, model.policy), _layers(model)
    assert isinstance(space, spaces.Box)
    linear = [layer for layer in layers if isinstance(layer, nn.Linear)]
    sizes = [linear[0].weight.shape[1], *(layer.weight.shape[0] for layer in linear)]
    kwargs = {
        "layers": sizes,
        "activation": policy.activation_fn.__name__,
        "net_fields": "observation",
        "opt_fields": "action",
    }
    known, normalizer = {}, model.get_vec_normalize_env()
    if normalizer is not None and normalizer.norm_obs:
        seen: Any = normalizer.obs_rms
        scale = np.sqrt(seen.var + normalizer.epsilon)
        known["observation"] = Normalization(seen.mean, scale)
        if np.isfinite(normalizer.clip_obs):
            _LOG.warning(
                "VecNormalize clips observations at %g standard deviations, but the saved policy "
                "does not: train with clip_obs=np.inf to get the same actions.",
                normalizer.clip_obs,
            )
    config = NetworkConfig(
        "torch/fc", network_kwargs=kwargs, loss="MSELoss", optimizer="Adam", lr=0.0
    )
    learner: Any = Learner(config, trains=True)
    fields = [
        Field("observation", space.shape, str(space.dtype)),
        Field("action", (sizes[-1],), "float32"),
    ]
    learner.bind({field.name: field for field in fields}, known)
    learner.network.layers.load_state_dict(layers.state_dict())
    files.make_folder(Path(folder))
    path: Path = learner.save(Path(folder) / "network")
    return path


def _layers(model: BaseAlgorithm) -> nn.Sequential:
    """Return the layers from observation to action, after checking that there is nothing else."""
    policy: Any = model.policy
    acted, problem = model.action_space, None
    if not isinstance(policy, ActorCriticPolicy) or policy.squash_output:
        problem = f"its policy is {type(policy).__name__}, whose actor is not purely layers"
    elif type(policy.mlp_extractor) is not MlpExtractor:
        problem = f"its policy has a {type(policy.mlp_extractor).__name__}"
    elif type(policy.features_extractor) is not FlattenExtractor or not isinstance(
        model.observation_space, spaces.Box
    ):
        problem = f"it observes {model.observation_space}, not an array of numbers"
    elif policy.normalize_images and is_image_space(model.observation_space):
        problem = "it observes images"
    elif isinstance(acted, spaces.MultiBinary):
        problem = f"its action space is {acted}"
    if problem is not None:
        raise ConfigError(
            f"{type(model).__name__} cannot be saved as a physx policy: {problem}. "
            'PPO and A2C with an "MlpPolicy" can.'
        )
    return nn.Sequential(*policy.mlp_extractor.policy_net, policy.action_net)
