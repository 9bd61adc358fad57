"""The software on board: observation, policy, action, pilot and hover controller."""
