"""The policy and what flies with it on board: observation, action, pilot, hover controller."""
