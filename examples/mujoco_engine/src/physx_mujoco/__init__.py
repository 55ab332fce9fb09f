"""physx plugin `mujoco`: simulations with MuJoCo."""
