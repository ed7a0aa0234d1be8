"""Short-horizon actor-critic (Xu et al., 2022): gradients through the simulator."""
