"""The packages whose environments are tested: what pip installs, how environments are made, and what to know. Data alone."""

from dataclasses import replace
from typing import Any

from benchmark.compatibility.package_types import Environment, Learning, Package, made

HINDSIGHT: dict[str, Any] = dict(policy="MultiInputPolicy", replay_buffer="HerReplayBuffer")
# As `hyperparams/cgp.yml` has them
SMALL: dict[str, Any] = dict(learning_starts=1_000, buffer_size=10_000, policy_kwargs=dict(net_arch=[64, 64]))
PENDULUM = Learning(5_000, dict(learning_rate=2e-3, batch_size=64, gamma=0.98, tau=0.02, **SMALL))
# The defaults, but for smaller networks and fewer random steps
DEFAULTS = Learning(20_000, SMALL | dict(buffer_size=20_000))
REACH = Learning(3_000, dict(batch_size=256, gamma=0.95, **SMALL), normalize=True)
# envpool's environments are no environments of SB3's
ENVPOOL = """\
import envpool
import numpy as np
from stable_baselines3.common.vec_env import VecEnvWrapper, VecMonitor


class EnvPoolAdapter(VecEnvWrapper):
    def seed(self, seed=None):
        return [None] * self.num_envs  # the seed is an argument of envpool.make

    def reset(self):
        return self.venv.reset()[0]

    def step_async(self, actions):
        self.actions = actions

    def step_wait(self):
        observations, rewards, terminated, truncated, _ = self.venv.step(self.actions)
        observations, dones = observations.copy(), terminated | truncated
        infos = [{} for _ in dones]
        for i in np.flatnonzero(dones):
            infos[i]["terminal_observation"] = observations[i].copy()
            infos[i]["TimeLimit.truncated"] = bool(truncated[i] and not terminated[i])
            observations[i] = self.venv.reset(np.array([i]))[0][0]
        return observations, rewards, dones, infos


env = VecMonitor(EnvPoolAdapter(envpool.make("Pendulum-v1", env_type="gymnasium", num_envs=2, seed=0)))"""
SUPERSUIT = """\
import supersuit
from mpe2 import simple_spread_v3
from stable_baselines3.common.vec_env import VecEnvWrapper, VecMonitor


class SupersuitAdapter(VecEnvWrapper):
    def seed(self, seed=None):
        self.venv.venv.reset(seed=seed)
        return [seed] * self.num_envs

    def reset(self):
        return self.venv.reset()

    def step_wait(self):
        observations, rewards, dones, infos = self.venv.step_wait()
        for info, done in zip(infos, dones):
            info["TimeLimit.truncated"] = bool(done)  # these episodes end by their length alone
        return observations, rewards, dones, infos


agents = supersuit.pettingzoo_env_to_vec_env_v1(simple_spread_v3.parallel_env(continuous_actions=True))
env = supersuit.concat_vec_envs_v1(agents, 1, base_class="stable_baselines3")
env = VecMonitor(SupersuitAdapter(env))"""
ALOHA = """\
import os

os.environ["MUJOCO_GL"] = "egl"  # draws without a display

import gym_aloha
from gymnasium.wrappers import FilterObservation, FlattenObservation
from stable_baselines3.common.env_util import make_vec_env


def joints(env):
    return FlattenObservation(FilterObservation(env, ["agent_pos"]))


arguments = dict(obs_type="pixels_agent_pos", observation_width=64, observation_height=48)
env = make_vec_env("gym_aloha/AlohaTransferCube-v0", env_kwargs=arguments, wrapper_class=joints)"""
# MuJoCo's version is that of constraints.txt: later ones lack a field that these packages read
MUJOCO = "mujoco==3.8.0"

PACKAGES = (
    Package(
        "gymnasium",
        ("gymnasium[classic-control,mujoco,box2d]",),
        ("gymnasium", "mujoco", "box2d"),
        (
            Environment("Pendulum-v1", made("Pendulum-v1"), learning=PENDULUM),
            Environment(
                "MountainCarContinuous-v0",
                made("MountainCarContinuous-v0"),
                notes=("Rewards are found by action noise that is correlated in time (`hyperparams/cgp.yml`).",),
            ),
            Environment("HalfCheetah-v5", made("HalfCheetah-v5"), learning=DEFAULTS),
            Environment("Humanoid-v5", made("Humanoid-v5")),
            Environment(
                "LunarLanderContinuous-v3",
                made("LunarLanderContinuous-v3", replayed=True),
                wrappers="`replayed`",
                learning=DEFAULTS,
            ),
            Environment(
                "CarRacing-v3",
                made("CarRacing-v3"),
                policy="CnnPolicy",
                buffer_size=300,
                notes=("Observations are images: use a GPU, and a `buffer_size` that fits into the memory.",),
            ),
        ),
    ),
    Package(
        "gymnasium-robotics",
        ("gymnasium-robotics", MUJOCO),
        ("gymnasium-robotics", "mujoco"),
        (
            Environment("FetchReach-v4", made("FetchReach-v4", "gymnasium_robotics"), learning=REACH, **HINDSIGHT),
            Environment("FetchPush-v4", made("FetchPush-v4", "gymnasium_robotics"), **HINDSIGHT),
            Environment("AdroitHandDoor-v1", made("AdroitHandDoor-v1", "gymnasium_robotics")),
            Environment(
                "PointMaze_UMaze-v3",
                made("PointMaze_UMaze-v3", "gymnasium_robotics", "env_kwargs=dict(max_episode_steps=100)"),
                learning=DEFAULTS,
                **HINDSIGHT,
            ),
        ),
    ),
    Package(
        "panda-gym",
        ("panda-gym",),
        ("panda-gym", "pybullet"),
        (
            Environment("PandaReach-v3", made("PandaReach-v3", "panda_gym"), learning=REACH, **HINDSIGHT),
            Environment("PandaPickAndPlace-v3", made("PandaPickAndPlace-v3", "panda_gym"), **HINDSIGHT),
        ),
    ),
    Package(
        "dm_control",
        ("dm_control<=1.0.40", "shimmy[dm-control]", MUJOCO),
        ("dm-control", "shimmy", "mujoco"),
        (
            Environment(
                "dm_control/cartpole-swingup-v0",
                made("dm_control/cartpole-swingup-v0", "shimmy"),
                policy="MultiInputPolicy",
                learning=DEFAULTS,
            ),
            Environment(
                "dm_control/walker-walk-v0",
                "import shimmy\nfrom gymnasium.wrappers import FlattenObservation\n"
                "from stable_baselines3.common.env_util import make_vec_env\n\n"
                'env = make_vec_env("dm_control/walker-walk-v0", wrapper_class=FlattenObservation)',
                wrappers="`FlattenObservation`",
                learning=DEFAULTS,
            ),
        ),
    ),
    Package(
        "metaworld",
        ("metaworld",),
        ("metaworld", "mujoco"),
        (
            Environment(
                "Meta-World/MT1 reach-v3",
                made("Meta-World/MT1", "metaworld", 'env_kwargs=dict(env_name="reach-v3", seed=0)'),
                learning=DEFAULTS,
            ),
        ),
        ("metaworld 3.1 needs MuJoCo 3.3.0. With `-c constraints.txt`, pip installs 3.0.",),
    ),
    Package(
        "gym-pusht",
        ("gym-pusht",),
        ("gym-pusht", "pymunk"),
        (
            Environment(
                "gym_pusht/PushT-v0",
                made("gym_pusht/PushT-v0", "gym_pusht", 'env_kwargs=dict(obs_type="state")', replayed=True),
                wrappers="`replayed`",
                learning=DEFAULTS,
            ),
        ),
    ),
    Package(
        "highway-env",
        ("highway-env",),
        ("highway-env",),
        (
            Environment(
                "parking-v0",
                made("parking-v0", "highway_env", replayed=True),
                wrappers="`replayed`",
                learning=DEFAULTS,
                notes=(
                    "For tasks with discrete actions, pass "
                    '`env_kwargs=dict(config={"action": {"type": "ContinuousAction"}})`.',
                ),
                **HINDSIGHT,
            ),
        ),
    ),
    Package(
        "pybullet_envs_gymnasium",
        ("pybullet_envs_gymnasium",),
        ("pybullet-envs-gymnasium", "pybullet"),
        (
            Environment(
                "InvertedPendulumBulletEnv-v0",
                made("InvertedPendulumBulletEnv-v0", "pybullet_envs_gymnasium", replayed=True),
                wrappers="`replayed`",
                learning=DEFAULTS,
            ),
            Environment(
                "HalfCheetahBulletEnv-v0",
                made("HalfCheetahBulletEnv-v0", "pybullet_envs_gymnasium", replayed=True),
                wrappers="`replayed`",
                learning=DEFAULTS,
            ),
        ),
    ),
    Package(
        "robosuite",
        ("robosuite", "h5py"),
        ("robosuite", "mujoco"),
        (
            Environment(
                "Lift (Panda)",
                "import robosuite\nfrom robosuite.wrappers import GymWrapper\n"
                "from stable_baselines3.common.env_util import make_vec_env\n\n\n"
                "def make():\n"
                '    lift = robosuite.make("Lift", robots="Panda", has_renderer=False, has_offscreen_renderer=False,\n'
                "                          use_camera_obs=False, reward_shaping=True, horizon=100)\n"
                "    return GymWrapper(lift)\n\n\n"
                "env = make_vec_env(make)",
                wrappers="`GymWrapper`",
            ),
        ),
    ),
    Package(
        "mpe2",
        ("mpe2", "supersuit"),
        ("mpe2", "supersuit", "pettingzoo"),
        (
            Environment(
                "simple_spread_v3",
                SUPERSUIT,
                wrappers="supersuit's, an adapter",
                learning=DEFAULTS,
                notes=("All agents share one policy. The adapter seeds the environments and reports time limits.",),
            ),
        ),
    ),
    Package(
        "envpool",
        ("envpool",),
        ("envpool",),
        (
            Environment(
                "Pendulum-v1",
                ENVPOOL,
                wrappers="an adapter",
                # Two environments share a step
                learning=replace(PENDULUM, arguments=PENDULUM.arguments | dict(gradient_steps=-1)),
                notes=("The adapter resets environments as SB3 expects, and keeps the last observation of an episode.",),
            ),
        ),
    ),
    Package(
        "gym-aloha",
        ("gym-aloha", MUJOCO),
        ("gym-aloha", "dm-control", "mujoco"),
        (
            Environment(
                "gym_aloha/AlohaTransferCube-v0",
                ALOHA,
                wrappers="`FilterObservation`, `FlattenObservation`",
                notes=("SB3 takes no nested `Dict` observations: the policy observes the joints alone.",),
            ),
        ),
    ),
)
