"""PPO in rsl_rl's terms: the rollout is one CUDA graph, the update another."""
