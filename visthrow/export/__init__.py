"""Exports of a policy's network for programs that run neither Python nor torch.

Both exports hold the network alone: normalised actions from the observation of
:mod:`visthrow.onboard.observations`. The caller builds the observation, clips the action and scales
it (:mod:`visthrow.onboard.actions`).
"""
