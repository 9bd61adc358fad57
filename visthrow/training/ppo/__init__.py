"""PPO in rsl_rl's terms as a chain of device operations: the rollout is one CUDA graph, the update
another.

rsl_rl's update looks at the KL divergence and at three losses on the host in every minibatch and
launches each of its small operations by itself; on a large GPU that takes longer than the
arithmetic. Here the same is computed with fixed shapes and buffers that keep their places, the loss
with its gradient in one kernel, and the host looks once, at the end."""
