"""First-order training: flights of the simulator, gradients through a surrogate of it of one step.

A gradient takes one batch of flights in which nothing is released. Where the payload would land is
foreseen at every step, so a flight knows the outcome of each release that it could have made. The
release becomes smooth by a hazard, the probability ``h = sigmoid((a - threshold) / width)`` that
the latch trips in a step, and the cost of a flight is the mean over the step of release: with the
survival S[k] = prod_(j < k) (1 - h[j]),

    - sum_k S[k] h[k] (reward at release k) - sum_k S[k - lag] (rewards while carrying) + S[end]
      (penalty of an end)

On a schedule the width falls and the value of h becomes the latch's, 0 or 1, while its slope stays
the sigmoid's: what is differentiated is then what is flown, and the width is that of a kernel
estimate of how many releases a change moves. Soft barriers stand before the bounds, where rewards
have no slope, and before a slack rope, which the vehicle does not move. Derivatives run backward
through surrogate and network, and decay by a factor each step."""
