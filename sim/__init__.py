"""Batched hybrid simulator of a quadrotor with a cable-suspended payload, in Warp.

:class:`sim.hybrid.HybridSim` simulates vehicle, rope and payload, or the vehicle alone.
:mod:`sim.reference` is an independent plant on MuJoCo for small batches."""
