"""Import of MuJoCo's batches, with a clear error for a mixed installation."""

try:
    from mujoco.batch import Batch as Batch
except AttributeError as error:  # MuJoCo 3 was installed over parts of mujoco-core 4
    raise ModuleNotFoundError(
        f"mujoco.batch is of another MuJoCo than 'mujoco' here: {error}", name="mujoco.batch"
    ) from error
