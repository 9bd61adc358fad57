"""Many episodes side by side, of which all begin or all go on."""

import torch

COUNT = 4096
FRESH = torch.ones(COUNT, dtype=torch.bool)
OLD = ~FRESH
LIKE = torch.zeros(COUNT)
