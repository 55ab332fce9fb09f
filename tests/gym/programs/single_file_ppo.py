"""PPO in one file, with Gymnasium's own vector environments and wrappers, as CleanRL's scripts use
them: single_file_ppo.py ID STEPS. Prints the mean return of the first and the last tenth of the
episodes; knows nothing of physx but the import that registers the environments.
"""

import sys

import gymnasium as gym
import numpy as np
import torch
from torch import nn

import physx_gym  # noqa: F401

ENVS, LENGTH, EPOCHS, PARTS, GAMMA, LAMBDA = 8, 64, 8, 4, 0.98, 0.9


def make(id):
    def thunk():
        env = gym.make(id)
        env = gym.wrappers.FlattenObservation(env)
        env = gym.wrappers.RecordEpisodeStatistics(env)
        if isinstance(env.action_space, gym.spaces.Box):
            env = gym.wrappers.ClipAction(env)
        env = gym.wrappers.NormalizeObservation(env)
        return gym.wrappers.TransformReward(env, lambda reward: reward * 0.1)

    return thunk


def layers(inputs, outputs):
    return nn.Sequential(
        nn.Linear(inputs, 64), nn.Tanh(), nn.Linear(64, 64), nn.Tanh(), nn.Linear(64, outputs)
    )


id, total = sys.argv[1], int(sys.argv[2])
torch.manual_seed(1)
envs = gym.vector.SyncVectorEnv(
    [make(id)] * ENVS, autoreset_mode=gym.vector.AutoresetMode.SAME_STEP
)
observed = envs.single_observation_space.shape[0]
discrete = isinstance(envs.single_action_space, gym.spaces.Discrete)
acts = envs.single_action_space.n if discrete else envs.single_action_space.shape[0]
actor, critic = layers(observed, int(acts)), layers(observed, 1)
log_std = nn.Parameter(torch.zeros(int(acts)))
optimizer = torch.optim.Adam([*actor.parameters(), *critic.parameters(), log_std], 2.5e-3, eps=1e-5)


def policy(states):
    if discrete:
        return torch.distributions.Categorical(logits=actor(states))
    normal = torch.distributions.Normal(actor(states), log_std.exp())
    return torch.distributions.Independent(normal, 1)


returns = []
state = torch.as_tensor(envs.reset(seed=1)[0], dtype=torch.float32)
for _ in range(total // (ENVS * LENGTH)):
    rows = []
    for _ in range(LENGTH):
        with torch.no_grad():
            chosen = policy(state)
            action = chosen.sample()
            row = [state, action, chosen.log_prob(action), critic(state)[:, 0]]
        following, reward, terminated, truncated, infos = envs.step(action.numpy())
        done = np.logical_or(terminated, truncated)
        if "final_info" in infos:
            returns += list(infos["final_info"]["episode"]["r"][done])
        rows.append([*row, torch.as_tensor(reward).float(), torch.as_tensor(done).float()])
        state = torch.as_tensor(following, dtype=torch.float32)
    states, actions, logs, values, rewards, ends = (
        torch.stack(part) for part in zip(*rows, strict=True)
    )
    with torch.no_grad():
        advantages, advantage = torch.zeros_like(rewards), torch.zeros(ENVS)
        after = critic(state)[:, 0]
        for t in reversed(range(LENGTH)):
            goes_on = 1 - ends[t]
            error = rewards[t] + GAMMA * after * goes_on - values[t]
            advantages[t] = advantage = error + GAMMA * LAMBDA * goes_on * advantage
            after = values[t]
    targets = (advantages + values).flatten()
    states, actions, logs = states.flatten(0, 1), actions.flatten(0, 1), logs.flatten()
    advantages = advantages.flatten()
    for _ in range(EPOCHS):
        for part in torch.randperm(len(logs)).chunk(PARTS):
            chosen = policy(states[part])
            ratio = (chosen.log_prob(actions[part]) - logs[part]).exp()
            gain = (advantages[part] - advantages[part].mean()) / (advantages[part].std() + 1e-8)
            surrogate = torch.min(ratio * gain, ratio.clamp(0.8, 1.2) * gain).mean()
            misfit = (critic(states[part])[:, 0] - targets[part]).square().mean()
            optimizer.zero_grad()
            (0.5 * misfit - surrogate).backward()
            nn.utils.clip_grad_norm_([*actor.parameters(), *critic.parameters(), log_std], 0.5)
            optimizer.step()
envs.close()
tenth = max(1, len(returns) // 10)
print(f"{np.mean(returns[:tenth]):.1f} {np.mean(returns[-tenth:]):.1f}")
