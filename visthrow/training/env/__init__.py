"""The throwing task as a vectorised environment, and its optional parts."""

from visthrow.training.env.throw_env import ThrowEnv as ThrowEnv
