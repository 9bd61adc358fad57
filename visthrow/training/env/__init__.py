"""The throwing task as a vectorised environment, with its options as parts."""

from visthrow.training.env.throw_env import ThrowEnv as ThrowEnv
