"""A trainer: unmodified godot-rl in a process of its own, which may then spin or hang alone.

Usage: trainer.py SCENARIO PORT [ENV_PATH]. The last line of output is JSON: what it saw.
"""

from __future__ import annotations

import json
import os
import sys

import numpy as np


def godot_env(port, path):
    from godot_rl.core.godot_env import GodotEnv

    env = GodotEnv(env_path=path, port=port, seed=5, action_repeat=2, framerate=60, speedup=8)
    first, _ = env.reset()
    camera = first[0]["camera_2d"]
    actions = [[np.array([0.5, -1.0], np.float32), np.int64(2)] for _ in range(env.num_envs)]
    step = env.step(actions, order_ij=True)
    return {
        "num_envs": env.num_envs,
        "spaces": [str(env.observation_space), str(env.action_space)],
        "camera": [str(camera.dtype), camera.tolist()],
        "positions": [[seen["position"] for seen in seen_by] for seen_by in (first, step[0])],
        "step": step[1:],
        "call": env.call("who"),
    }


def clean_rl(port, path):
    from godot_rl.wrappers.clean_rl_wrapper import CleanRLGodotEnv

    env = CleanRLGodotEnv(env_path=path, n_parallel=2 if path else 1, seed=11, port=port)
    first, _ = env.reset(seed=0)
    seen, ends = [first.tolist()], []
    for number in range(40):
        actions = np.full((env.num_envs, 1), number % 3 != 0, np.int64)
        observations, rewards, done, _, infos = env.step(actions)
        seen.append(observations.tolist())
        ends.append([done, [info.get("terminal_observation") for info in infos]])
        assert rewards == [1.0] * env.num_envs
    statuses = []
    if path:
        env.close()
        statuses = [one.proc.wait(timeout=30) for one in env.envs]
    return {"num_envs": env.num_envs, "seen": seen, "ends": ends, "statuses": statuses}


def stable_baselines(port, path):
    from godot_rl.wrappers.stable_baselines_wrapper import StableBaselinesGodotEnv
    from stable_baselines3 import PPO
    from stable_baselines3.common.vec_env.vec_monitor import VecMonitor

    env = VecMonitor(StableBaselinesGodotEnv(env_path=path, n_parallel=2, seed=11, port=port))
    model = PPO("MultiInputPolicy", env, n_steps=64, batch_size=64, device="cpu")
    model.learn(512)
    env.close()
    lengths = [int(episode["l"]) for episode in model.ep_info_buffer]
    returns = [float(episode["r"]) for episode in model.ep_info_buffer]
    return {"num_envs": env.num_envs, "updates": model._n_updates, "ends": [lengths, returns]}


def petting_zoo(port, path):
    from godot_rl.wrappers.petting_zoo_wrapper import GDRLPettingZooEnv

    config = {"env_path": path, "action_repeat": None, "speedup": None}
    env = GDRLPettingZooEnv(port=port, show_window=False, config=config)
    first, _ = env.reset()
    actions = {agent: env.action_space(agent).sample() for agent in env.agents}
    observations, rewards, ended, _, infos = env.step(actions)
    return {
        "agents": env.agents,
        "policies": env.agent_policy_names,
        "levels": [first[agent]["level"] for agent in env.agents]
        + [observations[agent]["level"] for agent in env.agents],
        "rest": [list(rewards.values()), list(ended.values()), list(infos.values())],
    }


if __name__ == "__main__":
    scenario, port, *path = sys.argv[1:]
    told = globals()[scenario](int(port), path[0] if path else None)
    print(json.dumps(told), flush=True)
    os._exit(0)  # without godot-rl's farewell at exit, which takes a second for each environment
