"""The seven blocks of the analytical quadrotor (Table I of the paper), one file each, as pure Warp
functions.

Every function is generic over the precision: its arguments are structs and vectors of
:class:`sim.kernels.structs.Types`. The argument ``p`` is always the whole vehicle struct. The
equations are in :mod:`sim.params`."""
